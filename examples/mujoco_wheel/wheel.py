"""A tyre on a plane in MuJoCo, at a slip and under a load: pip install mujoco."""

import mujoco
import numpy as np

RADIUS = 0.4  # m
SPEED = 1.0  # m/s
SECONDS = 1.0
STEP_MS = 2.0
# The axle is pressed down and damped, and a flywheel keeps the slip whatever the friction is.
RIG = """
<mujoco>
  <option timestep="{step}" integrator="implicitfast" cone="elliptic"/>
  <default><geom friction="{mu}" solref="{soft} {damped}"/></default>
  <worldbody>
    <geom type="plane" size="0 0 1"/>
    <body pos="0 0 0.4">
      <joint name="along" type="slide" axis="1 0 0"/>
      <joint name="up" type="slide" axis="0 0 1" damping="1e4"/>
      <geom type="sphere" size="0.05" mass="30" contype="0" conaffinity="0"/>
      <body>
        <joint name="spin" type="hinge" axis="0 1 0" armature="1e5"/>
        <geom type="ellipsoid" size="0.4 0.1 0.4" mass="20"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <velocity joint="along" kv="1e6"/>
    <velocity joint="spin" kv="1e7"/>
    <motor joint="up"/>
  </actuator>
</mujoco>
"""


def reading(theta, slip, load, step_ms):
    """Return the pull (N): what holds the axle at its speed, over the second half."""
    mu, soft, damped = theta
    model = mujoco.MjModel.from_xml_string(
        RIG.format(step=step_ms / 1000.0, mu=mu, soft=soft, damped=damped)
    )
    data = mujoco.MjData(model)
    weight = 9.81 * model.body_mass.sum()
    data.ctrl[:] = SPEED, SPEED / RADIUS / (1.0 - slip), weight - 1000.0 * load
    data.qvel[:] = SPEED, 0.0, data.ctrl[1]
    pulls = np.empty(round(1000.0 * SECONDS / step_ms))
    for i in range(pulls.size):
        mujoco.mj_step(model, data)
        pulls[i] = -data.qfrc_actuator[0]
    return pulls[pulls.size // 2 :].mean()


def pull(theta, conditions, step_ms=STEP_MS):
    """Return the pull (N), shape (n,), of one parameter vector; steps in ms, one or of each row."""
    steps = np.broadcast_to(step_ms, conditions["slip"].shape)
    rows = zip(conditions["slip"], conditions["load"], steps, strict=True)
    return np.array([reading(theta, *row) for row in rows])

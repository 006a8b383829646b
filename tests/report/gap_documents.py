"""Documents of diagnoses from fixed numbers: one for each rule of the verdict."""

from __future__ import annotations

from calib.gap.corrected import Shrink
from calib.gap.document import (
    Cause,
    DataFile,
    Definition,
    Design,
    Expected,
    Explanation,
    GapDocument,
    Next,
    Output,
    Parameter,
    RunTrend,
    Size,
    TrackRecord,
    Unlisted,
    Untested,
    UnusedRow,
)
from calib.gap.laboratory_bias import Bias
from calib.gap.mixture import Region
from calib.gap.noise import Noise
from calib.gap.suggestions import Suggestion

CONDITIONS = {
    "slip_ratio": (0.05, 0.2, 0.4, 0.6),
    "inflation_pressure_psi": (18.0, 30.0, 42.0, 30.0),
    "run_order": (0.0, 1.0, 2.0, 3.0),
}
PULL = Output(
    name="drawbar_pull", title="Magic Formula", n_lab=30, relative=False,
    noise=Noise(0.025, rho=1.0), latex=("$H = D s$",), numbers="2-3",
    parametrisation="K about {pressure:g} psi", references={"pressure": 30.0}, parameters=("K",),
    rows=(0, 1, 2, 3), measured=(0.2, 0.6, 0.9, 1.1), before=(0.25, 0.7, 1.0, 1.2),
    after=(0.21, 0.6, 0.92, 1.1), noise_sd=(0.025, 0.03, 0.03, 0.04), gap=(-0.04, -0.1, -0.08, 0.1),
    gap_sd=(0.02, 0.02, 0.02, 0.02), probability=(0.4, 0.98, 0.9, 0.97),
    residual=(-0.4, 0.1, 2.3, -0.2),
)  # fmt: skip
RUT = Output(
    **(vars(PULL) | {"name": "rut_depth", "relative": True, "noise": Noise(0.05, kappa=0.8)})
)
ALONG_SLIP = Region("drawbar_pull", {"slip_ratio": (0.2, 0.4)}, -0.09, (-0.12, -0.06), 0.97)
EVERYWHERE = Region("rut_depth", {"slip_ratio": (0.0, 0.7)}, 4.0, (3.0, 5.0), 1.0)
SHRINK = Shrink(0.11, 0.04, 0.63, (-0.05, 0.8), 0.03)
DRIFT = Cause(
    "sensor_drift", 0.97, 0.8, (0.6, 0.95), "zero and span",
    Expected((), "drawbar_pull", (-0.01, 0.014), (0.19, 0.025)), ("force_offset", "sensor_drift"),
)  # fmt: skip
GAUGE = Cause(
    "pressure_gauge_bias", 0.6, 0.2, (0.0, 0.5), "against another gauge",
    Expected((Parameter("pressure_gauge_bias", "gain", "1", 0.1, 0.02, "value", (0.1, 0.02)),
              Parameter("pressure_gauge_bias", "offset", "psi", 3.0, 2.0, "limit", (6.3,)))),
    ("pressure_gauge_bias",),
)  # fmt: skip
LUGS = Cause("lug_thrust", 0.95, 0.7, (0.5, 0.9))
SOFTENING = Cause("moisture_softening", 0.3, 0.1, (0.0, 0.4))
NOTHING = Cause("unknown", 0.01, 0.0, (0.0, 0.0))
BIASES = (Bias("drawbar_pull", "K", "kN", 0.31, 0.01, 0.34, 3.0),
          Bias("drawbar_pull", "D", "1", 1.2, 0.1, 0.71, -4.9),
          Bias("drawbar_pull", "C", "1", 1.5, 0.1, 1.59, 0.9))  # fmt: skip
SUGGESTIONS = (
    Suggestion("drawbar_pull", "step", ("slip_ratio",), 0.25, True, False, 0.6, 0.42),
    Suggestion("drawbar_pull", "linear", ("run_order",), 0.0, False, True, 0.2, 0.3),
    Suggestion("drawbar_pull", "quadratic", ("slip_ratio",), 0.0, False, False, 0.1, 0.2),
    Suggestion("drawbar_pull", "product", ("slip_ratio", "inflation_pressure_psi"), 0.0, False,
               True, 0.07, 0.1),
)  # fmt: skip
RUNS = RunTrend(("drawbar_pull",), 0.93, (("drift", 0.5), ("step", 0.4), ("neither", 0.03)))


def gap(verdict: str, probabilities: dict[str, float], **changes: object) -> GapDocument:
    """Return a document with these explanations, the most probable first."""
    thrust = Parameter("lug_thrust", "thrust", "1", 0.09, 0.01, "value", (0.09, 0.01))
    half_way = Parameter("lug_thrust", "half_way", "1", 2.0, 1.4, "range", (2.0, 0.6, 6.0), True)
    shift = Parameter("drawbar_pull", "K", "percent", 12.0, 3.0, "value", (12.0, 3.0))
    given = {
        "name": "soft <field>", "seed": 1, "verdict": verdict, "outputs": (PULL,),
        "explanations": tuple(
            Explanation(
                n, p, 0.1, 3.0 if n != "none" else 0.0, 1.0 + i,
                (thrust, half_way) if "lug_thrust" in n else (),
                *(((shift,), "soil") if n == "parameter_shift" else ()),
            )
            for i, (n, p) in enumerate(probabilities.items())
        ),
        "definitions": (Definition("lug_thrust", "thrust", "1", "of the load", "n(0, 1)", "[1]"),),
        "track_record": TrackRecord(0.9, 1.0, 1774, 1737), "causes": (LUGS,), "remainder": NOTHING,
        "titles": {"lug_thrust": "tread lugs add thrust", "sensor_drift": "the reading drifts",
                   "pressure_gauge_bias": "true pressure differs from the recorded one"},
        "sizes": (Size("end", "drawbar_pull", 0.13, 0.04, place="stretch", column="slip_ratio",
                       ends=(0.4, 0.6)),),
        "conditions": CONDITIONS, "covered": {"slip_ratio": (0.02, 0.6)}, "regions": (ALONG_SLIP,),
        "false_discovery_rate": 0.03, "leading": (0,), "shrink": {"drawbar_pull": SHRINK},
        "judged_on": "new conditions", "laboratory_bias": BIASES,
        "design": Design({"lug_thrust": 0.5, "sensor_drift": 0.9},
                         {"lug_thrust": 0.7, "sensor_drift": float("inf")},
                         (("lug_thrust", "sensor_drift", 0.96),),
                         (("lug_thrust", "sensor_drift"),)),
        "gap": 4.0, "left": 0.32, "coarsening": 1.1, "uncoarsened": 0.97, "before": 4.0,
        "smallest": 0.7, "files": (DataFile("field", "field.csv", 4, "a" * 64),),
        "next_measurements": (
            Next(("lug_thrust", "sensor_drift"), {"slip_ratio": 0.65, "speed_m_s": 2.0}, 1.2,
                 ("slip_ratio", "speed_m_s"), True, 3),
        ),
    }  # fmt: skip
    return GapDocument(**(given | changes))  # type: ignore[arg-type]


# By the rule that decides; some have a second one.
DOCUMENTS: dict[str, GapDocument] = {
    "none": gap("none", {"none": 0.97, "sensor_drift": 0.03}, causes=(), shrink={}, regions=(),
                leading=(), sizes=(), next_measurements=()),
    "not shown": gap("none", {"none": 0.6, "sensor_drift": 0.4}, smallest=float("nan"),
                     put_in=("sensor drift suspected (0.5)",),
                     suspected=("sensor_drift", "rutting"),
                     not_testable={"rutting": "no rut_depth"}, without_context={"none": 0.8}),
    "trend": gap("unknown", {"unknown": 0.8, "none": 0.2}, outputs=(PULL, RUT), causes=(),
                 runs=RunTrend(("drawbar_pull", "rut_depth"), 0.8, (("neither", 0.8),), True),
                 remainder=Cause("unknown", 0.8, 1.0, (1.0, 1.0)), remainder_where=(EVERYWHERE,),
                 regions=(ALONG_SLIP, EVERYWHERE), leading=(0, 1), sizes=(),
                 unlisted=Unlisted("order", ("drawbar_pull", "rut_depth"))),
    "wander": gap("unknown", {"unknown": 0.95}, causes=(), sizes=(),
                  runs=RunTrend(("drawbar_pull",), 0.95, (("neither", 0.95), ("step", 0.01))),
                  unlisted=Unlisted("order", ("drawbar_pull",), beside="lug_thrust")),
    "over runs": gap("ambiguous", {"sensor_drift": 0.5, "sensor_step": 0.4}, runs=RUNS, sizes=(),
                     causes=(Cause("sensor_drift", 0.5, 0.5, (0.0, 1.0), "zero", faults=("a",)),)),
    "unknown": gap("unknown", {"unknown": 0.95}, causes=(), regions=(), leading=(),
                   unlisted=Unlisted("sinkage", ("drawbar_pull",), "rut_depth_mm", (22.0, 3.0),
                                     True, surest=ALONG_SLIP),
                   sizes=(Size("rms", "drawbar_pull", 0.1, 0.01),), suggestions=SUGGESTIONS),
    "unknown: in waves": gap("unknown", {"unknown": 0.95}, causes=(), sizes=(),
                             unlisted=Unlisted("ripple", ("drawbar_pull",))),
    "tie": gap("ambiguous", {"lug_thrust": 0.45, "sensor_drift": 0.4, "none": 0.1}, sizes=(),
               causes=(Cause("lug_thrust", 0.45, 0.4, (0.0, 1.0)),), judged_on="fitted rows"),
    "tie: of many": gap("ambiguous", {"lug_thrust": 0.3, **{f"e{i}": 0.05 for i in range(9)}},
                       next_measurements=(Next(("lug_thrust", "e1"), {}, 1e-4),)),
    "recalibrate": gap("effect", {"parameter_shift": 0.95}, next_measurements=(),
                       shift_if_same_soil=0.62,
                       causes=(Cause("parameter_shift", 0.95, 1.0, (1.0, 1.0)),),
                       sizes=(Size("rms", "drawbar_pull", 0.1, 0.01),)),
    "named": gap("effect", {"lug_thrust": 0.93, "sensor_drift": 0.07}, label="reconstructed",
                 causes=(LUGS, SOFTENING), judged_on="rows left out", parts=5,
                 untested=(Untested("rate_effect", "", ("speed_m_s",), {"speed_m_s": 2.0}),),
                 assumed={"pass_number": 1.0}, notes=("reconstructed data",),
                 warnings=("mind the <gap>",), command=("calib", "diagnose", "a b"),
                 versions={"numpy": "2"}, not_testable={"rut_rebound": "no rut_depth output"},
                 unused=(UnusedRow("drawbar_pull", 4, 0.1, 0.02, 0.9, "there is no reading"),),
                 prediction={"slip_percent": ("10.50", "20"), "drawbar_pull_kn_after": (0.3, 0.5)}),
    "named: but doubted": gap("effect", {"lug_thrust": 0.93}, doubts=("the field scatters",),
                              untested=(Untested("rate_effect", "no speed"),),
                              next_measurements=()),
    "named: instrument": gap("effect", {"sensor_drift": 0.97}, causes=(DRIFT, SOFTENING),
                            next_measurements=(), runs=RunTrend(("drawbar_pull",), 0.97,
                            (("drift", 0.97),), only=True, surest=0.97),
                            sizes=(Size("end", "drawbar_pull", 0.22, 0.01, reads=True, place="end",
                                        column="run_order"),)),
    "likely": gap("effect", {"lug_thrust+pressure_gauge_bias+sensor_drift": 0.6, "none": 0.1},
                  causes=(DRIFT, LUGS, GAUGE, SOFTENING),
                  remainder=Cause("unknown", 0.55, 0.1, (0.0, 0.3)), remainder_where=(ALONG_SLIP,),
                  sizes=(Size("rms", "drawbar_pull", 0.1, 0.01, together=True),
                         Size("rms", "rut_depth", 3.0, 0.2, together=True)),
                  outputs=(PULL, RUT), shrink={"drawbar_pull": SHRINK, "rut_depth": SHRINK},
                  excluded=("rut_rebound",)),
    "likely: step": gap("effect", {"sensor_step": 0.7, "unknown": 0.1},
                       causes=(Cause("sensor_step", 0.7, 1.0, (1.0, 1.0), "zero", faults=("a",)),
                               Cause("gauge", 0.2, 0.0, (0.0, 0.1), "against another")),
                       sizes=(Size("step", "drawbar_pull", -0.2, 0.01, True, ends=(12, 12)),
                              Size("step", "rut_depth", 0.8, 0.1, reads=True, relative=True,
                                   ends=(17, 23)),
                              Size("condition", "slip_ratio", 0.033, 0.002),
                              Size("end", "rut_depth", -4.0, 0.2, place="start"))),
}  # fmt: skip

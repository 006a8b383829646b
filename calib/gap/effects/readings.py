"""A drift and a step of the reading of any output, as of the drawbar cell's.

Sizes are parts of the laboratory's typical reading; where logarithms are compared, the reading is
wrong by a factor.
"""

from __future__ import annotations

from calib.gap.effects.instruments import SensorDrift, SensorStep

# A size as a part of the typical reading: as large as the drawbar cell's beside a pull of
# a fifth of the load.
_SIZE = 0.25
_SHAPES = {
    "curvature": 'dist = "lognormal"\nmedian = 1.0\nsd_log = 1.0',
    "half_way": 'dist = "lognormal"\nmedian = 0.5\nsd_log = 1.2',
    "zero_at": 'dist = "uniform"\nlower = 0.0\nupper = 1.0',
    "change_point": 'dist = "uniform"\nlower = 0.1\nupper = 0.9',
    "duration": 'dist = "lognormal"\nmedian = 0.02\nsd_log = 0.7',
}


class ReadingDrift(SensorDrift):
    """A drift with run order of an output's reading.

    Parameters
    ----------
    role, output : str
        Physical role of the output, and its name.
    unit : str
        In which it is compared.
    typical : float
        Of its readings; 1 where logarithms are compared.
    """

    def __init__(self, role: str, output: str, unit: str, typical: float) -> None:
        word = output.replace("_", " ")
        self.name, self.outputs, self.device = f"{output}_drift", (role,), f"{word} gauge"
        self.title = f"the {word} reading drifts with run order"
        self.latex = tuple(_of(word, unit, line) for line in SensorDrift.latex)
        self.priors = _priors(self.name, {"drift": _SIZE * typical}, unit, self.parameters[1:])


class ReadingStep(SensorStep):
    """A jump of an output's reading at some run; parameters as of `ReadingDrift`."""

    def __init__(self, role: str, output: str, unit: str, typical: float) -> None:
        word = output.replace("_", " ")
        self.name, self.outputs, self.device = f"{output}_step", (role,), f"{word} gauge"
        self.title = f"the {word} reading jumps at some run, as when a gauge is replaced or slips"
        self.latex = tuple(_of(word, unit, line) for line in SensorStep.latex)
        self.priors = _priors(self.name, {"jump": _SIZE * typical}, unit, self.parameters[1:])


def _of(word: str, unit: str, line: str) -> str:
    """An equation of the pull's reading as that of another."""
    symbol = r"\ln y" if unit == "1" else "y"
    line = line.replace(r"P_\mathrm{f} = P", rf"{symbol}_\mathrm{{f}} = {symbol}")
    return line.replace("the pull $P$", f"the {word} $y$")


def _priors(name: str, sizes: dict[str, float], unit: str, shapes: tuple[str, ...]) -> str:
    said = 'source = "This project: no published value was found; wide enough to be noticed"\n'
    return "\n".join(
        [
            f'model = "{name}"\n',
            *(
                f'[parameters.{size}]\ndist = "normal"\nmean = 0.0\nsd = {sd!r}\nunit = "{unit}"\n'
                f'reason = "Error of the reading, up to a fourth of a typical one"\n{said}'
                for size, sd in sizes.items()
            ),
            *(
                f'[parameters.{shape}]\n{_SHAPES[shape]}\nunit = "1"\n'
                'reason = "As of the drawbar reading"\n'
                'source = "Those of the priors sensor_drift and sensor_step"\n'
                for shape in shapes
            ),
        ]
    )

"""Tables that commands print: at most a screen of rows with value, unit and target."""

from collections.abc import Mapping, Sequence

from hrc_learn.viz.report import Measurement, show_measurements

_PER_CENT = 100.0
_FINEST = 0.01
"""Resolution of NRMSE [%] and of rotation errors [deg]: an encoder resolves 1e-4 rad."""

REPRESENTED = 2.0
"""Largest NRMSE at which a primitive represents its demonstration [%]: a centimetre in a motion
of half a metre, well above the noise of encoders at 30 frames a second."""
PREDICTED = 10.0
"""Largest error of an image Jacobian relative to the image motion [%]. Half of it is image
noise, and the controller converges from far larger errors."""
MARKER_RESOLUTION = 0.1
"""Mean error of a detected marker [px], the resolution of a target in the image."""

_OF_CHANNEL = {
    "joint": "joints",
    "pose": "end effector",
    "position": "end effector",
    "orientation": "orientation",
}
_HELD_OUT = {
    "mean": "by the mean",
    "contextual": "by start and goal",
    "nearest": "by the nearest",
}
_UNITS = ("px", "mm", "deg", "rad", "ms", "s", "%")


def show_values(
    title: str,
    values: Mapping[str, float],
    rows: Sequence[Measurement],
) -> None:
    """Print the main results of a fit.

    Args:
        title: Title of the table.
        values: All measured values, by their names in JSON.
        rows: The main ones, with titles.
    """
    more = len(values) - len(rows)
    show_measurements(rows, title=title, more=more, elsewhere="metrics.json")


def named(name: str, value: float) -> Measurement:
    """Measured value by its name in JSON, whose last word is the unit if it is one."""
    stem, _, unit = name.rpartition("_")
    known = stem and unit in _UNITS
    words = (stem if known else name).replace("_", " ")
    return Measurement(name=words, value=value, unit=unit if known else "")


def primitive_rows(values: Mapping[str, float]) -> list[Measurement]:
    """Main rows of `FittedPrimitives.metrics`, NRMSE relative to the range of motion."""
    rows = []
    if "demonstrations" in values:
        rows.append(Measurement(name="demonstrations", value=round(values["demonstrations"])))
    if "left_out_error" in values:
        rows.append(
            Measurement(
                name="held-out error, relative to the spread of actions",
                value=_PER_CENT * values["left_out_error"],
                unit="%",
            )
        )
    for channel, word in _OF_CHANNEL.items():
        held_out = {
            said: f"held_out_{channel}_{model}_nrmse_median"
            for model, said in _HELD_OUT.items()
            if f"held_out_{channel}_{model}_nrmse_median" in values
        }
        best = min(held_out, key=lambda said: values[held_out[said]], default="")
        shown = (
            # The maximum, so that one demonstration that is not represented shows.
            (f"{channel}_nrmse_max", "worst NRMSE of a demonstration", "%", REPRESENTED),
            (f"mean_{channel}_nrmse_median", "median NRMSE of the common model", "%", None),
            (held_out.get(best, ""), f"held out, {best}", "%", None),
            (f"{channel}_turn_rmse_max", "worst rotation error", "deg", None),
        )
        rows += [
            Measurement(
                name=f"{word}: {name}",
                value=(_PER_CENT if unit == "%" else 1.0) * values[key],
                unit=unit,
                target=target,
                resolution=_FINEST,
            )
            for key, name, unit, target in shown
            if key in values
        ]
    return rows


def image_jacobian_rows(values: Mapping[str, float]) -> list[Measurement]:
    """Main rows of `VisualServoSkill.metrics`."""
    rows = [
        Measurement(name="pairs of images", value=round(values["pairs"])),
        Measurement(name="neurons", value=round(values["neurons"])),
        Measurement(name="image motion in a pair", value=values["motion_px"], unit="px"),
        Measurement(
            name="held-out error, relative to that motion",
            value=_PER_CENT * values["held_out_relative"],
            unit="%",
            target=PREDICTED,
        ),
        Measurement(
            name="held-out error, worst part of the workspace",
            value=_PER_CENT * values["held_out_relative_worst_cell"],
            unit="%",
        ),
    ]
    for key, name, unit, resolution in (
        ("target_error_px", "target in the image, error", "px", MARKER_RESOLUTION),
        ("angle_spread_deg", "angle of object and gripper, spread", "deg", 0.0),
        ("approach_spread_deg", "orientation above the object, spread", "deg", 0.0),
    ):
        if key in values:
            value = values[key]
            rows.append(Measurement(name=name, value=value, unit=unit, resolution=resolution))
    return rows

"""Tables that commands print: at most a screen of rows, each with its unit and a verdict."""

from collections.abc import Mapping, Sequence

from hrc_learn.viz.report import Measurement, show_measurements

_PER_CENT = 100.0
_FINEST = 0.01
"""Of NRMSE [%] and of rotation errors [deg]: an encoder's 1e-4 rad is 0.006 deg."""

REPRESENTED = 2.0
"""NRMSE up to which a primitive represents its demonstration [%]: a centimetre of a motion of
half a metre, which noise of encoders and 30 frames a second leave room for."""
PREDICTED = 10.0
"""Error of an image Jacobian, of the image motion that it predicts [%]. Noise of the images
alone makes half of it, and the controller adapts from far worse (docs/controller.md)."""
MARKER_RESOLUTION = 0.1
"""Mean distance of a detected marker from its true pixel [px] (docs/vision.md): what is said of
a target in the image is no finer."""

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
    everything: bool = False,
) -> None:
    """Print what a fit came to.

    Args:
        title: Of the table.
        values: All that was measured, by the names that --json gives them.
        rows: What matters of it, in words.
        everything: All values rather than those rows.
    """
    every = [named(name, value) for name, value in values.items()]
    table, more = (every, 0) if everything else (rows, len(every) - len(rows))
    elsewhere = "--verbose, or metrics.json"
    show_measurements(table, everything, title=title, more=more, elsewhere=elsewhere)


def named(name: str, value: float) -> Measurement:
    """A measured value under its name in JSON, whose last word is the unit if it is one."""
    stem, _, unit = name.rpartition("_")
    known = stem and unit in _UNITS
    words = (stem if known else name).replace("_", " ")
    return Measurement(name=words, value=value, unit=unit if known else "")


def primitive_rows(values: Mapping[str, float]) -> list[Measurement]:
    """What matters of `FittedPrimitives.metrics`, NRMSE relative to the range of the motion."""
    rows = []
    if "demonstrations" in values:
        rows.append(Measurement(name="demonstrations", value=round(values["demonstrations"])))
    if "left_out_error" in values:
        rows.append(
            Measurement(
                name="error of demonstrations left out, of the spread of actions",
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
            # The worst of them: one demonstration that is not represented must not hide.
            (f"{channel}_nrmse_max", "worst NRMSE of a demonstration", "%", REPRESENTED),
            (f"mean_{channel}_nrmse_median", "median NRMSE, one for all", "%", None),
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
    """What matters of `VisualServoSkill.metrics`."""
    rows = [
        Measurement(name="pairs of images", value=round(values["pairs"])),
        Measurement(name="neurons", value=round(values["neurons"])),
        Measurement(name="image motion in a pair", value=values["motion_px"], unit="px"),
        Measurement(
            name="held-out error, of that motion",
            value=_PER_CENT * values["held_out_relative"],
            unit="%",
            target=PREDICTED,
        ),
        Measurement(
            name="the same, worst part of the workspace",
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

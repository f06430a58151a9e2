import numpy as np
import pytest
from rrd_reading import Rrd

from hrc_learn.viz import SweepRecording, SweptTrials
from hrc_learn.viz.figures import arrival_figure
from hrc_learn.viz.sweep_dashboard import record_sweep

GROUPS = ("0-90 deg", "90-180 deg")


def swept(seed: int, share: float) -> SweptTrials:
    rng = np.random.default_rng(seed)
    arrival = np.where(rng.random(60) < share, rng.uniform(1.0, 5.0, 60), np.inf)
    return SweptTrials(
        success=np.isfinite(arrival) & (arrival < 4.5),
        arrival=arrival,
        group=np.arange(60) % 2,
    )


@pytest.fixture(scope="module")
def sweep() -> SweepRecording:
    experiments = {"near": swept(0, 0.9), "row flipped": swept(1, 0.3)}
    return SweepRecording(title="Grasping", groups=GROUPS, experiments=experiments)


@pytest.fixture(scope="module")
def rrd(sweep, tmp_path_factory) -> Rrd:
    path = tmp_path_factory.mktemp("rrd") / "sweep.rrd"
    record_sweep(path, sweep)
    assert [file.name for file in path.parent.iterdir()] == ["sweep.rrd"]
    return Rrd(path)


def test_curves_count_who_has_arrived(sweep, rrd):
    time, shares = rrd.time("arrival/all"), rrd.scalars("arrival/all")
    for k, trials in enumerate(sweep.experiments.values()):
        for i in (0, 100, 250, 399):
            arrived = sum(t <= time[i] + 1e-9 for t in trials.arrival.tolist())
            assert shares[i, k] == pytest.approx(100 * arrived / 60)
    assert shares[-1, 0] == pytest.approx(100 * np.isfinite(swept(0, 0.9).arrival).mean())
    names = rrd.column("arrival/all", "SeriesLines:names", static=True)
    assert names == [["near", "row flipped"]]


def test_classes_have_curves_and_bars_of_their_own(sweep, rrd):
    flipped = sweep.experiments["row flipped"]
    ends = rrd.scalars("arrival/row_flipped")[-1]
    (bars,) = rrd.column("success/row_flipped", "BarChart:values", static=True)
    for group in range(2):
        chosen = flipped.group == group
        assert ends[group] == pytest.approx(100 * np.isfinite(flipped.arrival[chosen]).mean())
        share = 100 * flipped.success[chosen].mean()
        assert bars[0]["buffer"][group] == pytest.approx(share)


def test_the_table_says_it_in_numbers(sweep, rrd):
    ((text,),) = rrd.column("summary", "TextDocument:text", static=True)
    near = sweep.experiments["near"]
    median = np.quantile(near.arrival, 0.5, method="inverted_cdf")
    (line,) = [line for line in text.splitlines() if line.startswith("| near")]
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    assert cells[1:3] == ["60", f"{100 * near.success.mean():.1f}"]
    assert cells[-2] == f"{median:.2f}"
    (line,) = [line for line in text.splitlines() if line.startswith("| row")]
    assert "never" in line


def test_the_figure_has_a_panel_for_each_and_ends_in_its_shares(sweep):
    panels = [axes for axes in arrival_figure(sweep).axes if axes.axison]
    assert [axes.get_title(loc="left") for axes in panels] == ["near", "row flipped"]
    for axes, trials in zip(panels, sweep.experiments.values(), strict=True):
        curves = [line for line in axes.get_lines() if line.get_label() in GROUPS]
        dots = [line for line in axes.get_lines() if line.get_label() not in GROUPS]
        for group in range(2):
            chosen = trials.group == group
            shares = np.asarray(curves[group].get_ydata())
            assert shares[-1] == pytest.approx(100 * np.isfinite(trials.arrival[chosen]).mean())
            assert np.asarray(dots[group].get_ydata()) == pytest.approx(
                100 * trials.success[chosen].mean()
            )


@pytest.mark.parametrize(
    ("experiments", "complaint"),
    [
        ({}, "at least one experiment"),
        (
            {
                "none": SweptTrials(
                    success=np.zeros(0, bool), arrival=np.zeros(0), group=np.zeros(0, int)
                )
            },
            "'none' has no trials",
        ),
        (
            {
                "odd": SweptTrials(
                    success=np.ones(1, bool), arrival=np.ones(1), group=np.array([2])
                )
            },
            "trial of class 2",
        ),
    ],
)
def test_sweeps_that_make_no_sense_are_refused(experiments, complaint):
    with pytest.raises(ValueError, match=complaint):
        SweepRecording(title="", groups=GROUPS, experiments=experiments)

"""Files of a primitive, its coordinates, and what it keeps between calls."""

import copy
import json
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from demo_motions import arm_motion
from power_cuts import cut_off
from safetensors.torch import load_file, save_file
from torch.autograd import forward_ad

from hrc_learn.dmp import GaussianBasis, JointDMP, SpringDamper, response, trajectory

# Files


TIME, POSITION = arm_motion(n_samples=20, n_joints=2)


@pytest.fixture
def saved(tmp_path):
    names = ("shoulder", "elbow")
    dmp = JointDMP.fit(TIME, POSITION, n_basis=9, joint_names=names, scaling="amplitude")
    dmp.save(tmp_path / "primitive")
    return dmp, tmp_path / "primitive"


def test_a_saved_primitive_is_the_same(saved):
    dmp, folder = saved
    loaded = JointDMP.load(folder)
    torch.testing.assert_close(
        loaded.rollout(goal=[0.1, 0.2], speed=2.0).position,
        dmp.rollout(goal=[0.1, 0.2], speed=2.0).position,
        rtol=0,
        atol=0,
    )
    assert loaded.joint_names == ("shoulder", "elbow")
    assert loaded.units == "rad"
    torch.testing.assert_close(loaded.fit_report.nrmse, dmp.fit_report.nrmse)


def test_saving_replaces_whole_folders_and_leaves_nothing_else(saved):
    _, folder = saved
    JointDMP.fit(TIME, POSITION, n_basis=5).save(folder)
    assert JointDMP.load(folder).basis.count == 5
    assert sorted(p.name for p in folder.iterdir()) == [
        ".manifest.json",
        "config.json",
        "model.safetensors",
    ]
    assert [p.name for p in folder.parent.iterdir()] == ["primitive"]


def test_saving_replaces_no_model_of_another_program(tmp_path):
    """Many programs name their files so; only the contents tell whose they are."""
    (tmp_path / "bert").mkdir()
    (tmp_path / "bert" / "config.json").write_text('{"architectures": ["BERT"]}')
    (tmp_path / "bert" / "model.safetensors").write_bytes(b"weeks of training")
    with pytest.raises(ValueError, match="so it is not overwritten"):
        JointDMP.fit(TIME, POSITION).save(tmp_path / "bert")
    assert (tmp_path / "bert" / "model.safetensors").read_bytes() == b"weeks of training"


def test_saving_replaces_no_model_with_notes_beside_it(saved):
    _, folder = saved
    (folder / "notes.txt").write_text("good with the blue gripper")
    with pytest.raises(
        ValueError, match=r"not part of the saved model and would be lost, notes\.txt"
    ):
        JointDMP.fit(TIME, POSITION, n_basis=5).save(folder)
    assert (folder / "notes.txt").read_text() == "good with the blue gripper"


def test_a_save_cut_off_at_any_step_leaves_the_old_model_or_the_new(saved):
    _, folder = saved
    older, newer = (JointDMP.fit(TIME, POSITION, n_basis=count) for count in (4, 5))
    older.save(folder)
    for _ in cut_off(lambda: newer.save(folder)):
        assert JointDMP.load(folder).basis.count in (4, 5)
        older.save(folder)
        assert [p.name for p in folder.parent.iterdir()] == ["primitive"]


def test_saving_does_not_overwrite_what_is_no_primitive(tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").write_text("years of work")
    with pytest.raises(ValueError, match="so it is not overwritten"):
        JointDMP.fit(TIME, POSITION).save(tmp_path / "thesis")
    assert (tmp_path / "thesis" / "chapter.tex").read_text() == "years of work"


@pytest.mark.parametrize("name", ["config.json", "model.safetensors"])
def test_a_flipped_bit_is_noticed(saved, name):
    _, folder = saved
    content = bytearray((folder / name).read_bytes())
    content[-8] ^= 1
    (folder / name).write_bytes(content)
    with pytest.raises(ValueError, match=name):
        JointDMP.load(folder)


@pytest.mark.parametrize(
    ("field", "value", "complaint"),
    [
        ("version", 2, "config.json: version is 2, expected 1"),
        ("kind", "Cake", "config.json: kind is 'Cake', expected 'JointDMP'"),
        ("scaling", None, "config.json: field 'scaling' must be str, got None"),
        ("scaling", "cubic", "unknown scaling 'cubic'"),
        ("spring", {"alpha": -1.0}, "alpha must be positive"),
        ("basis", {"count": 8}, r"config\.json: field 'basis': 'type' is missing"),
        ("basis", {"type": "Wavelets"}, "field 'basis': unknown type 'Wavelets'"),
        ("spring", {"gamma": 1.0}, "field 'spring': .*gamma"),
        ("approach", 2.0, "approach must be a fraction"),
        ("joint_names", ["only"], "1 joint names for 2"),
    ],
)
def test_a_wrong_config_names_file_and_field(saved, field, value, complaint):
    _, folder = saved
    (folder / ".manifest.json").unlink()
    path = folder / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {field: value}))
    with pytest.raises(ValueError, match=complaint) as error:
        JointDMP.load(folder)
    assert str(folder) in str(error.value)


def test_a_missing_field_or_file_is_named(saved):
    _, folder = saved
    (folder / ".manifest.json").unlink()
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(
        json.dumps({k: config[k] for k in config if k != "basis"})
    )
    with pytest.raises(ValueError, match="field 'basis' is missing"):
        JointDMP.load(folder)
    (folder / "config.json").write_text("{")
    with pytest.raises(ValueError, match="not valid JSON"):
        JointDMP.load(folder)
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "model.safetensors").write_bytes(b"cut short")
    with pytest.raises(ValueError, match="not a safetensors file"):
        JointDMP.load(folder)
    (folder / "model.safetensors").unlink()
    with pytest.raises(FileNotFoundError, match=r"model\.safetensors"):
        JointDMP.load(folder)
    with pytest.raises(FileNotFoundError, match="no model was saved"):
        JointDMP.load(folder.parent)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda tensors: tensors.pop("goal"), "tensor 'goal' is missing"),
        (lambda tensors: tensors.update(goal=torch.zeros(5)), r"goal has shape \(5,\)"),
        (lambda tensors: tensors["weights"].fill_(torch.nan), "tensor 'weights' is not finite"),
    ],
)
def test_wrong_tensors_are_named(saved, change, complaint):
    _, folder = saved
    (folder / ".manifest.json").unlink()
    tensors = load_file(folder / "model.safetensors")
    change(tensors)
    save_file(tensors, folder / "model.safetensors")
    with pytest.raises(ValueError, match=complaint) as error:
        JointDMP.load(folder)
    assert str(folder) in str(error.value)


# Coordinates, and primitives that differ in these alone


NAMES = ("a", "b", "c")


@pytest.fixture
def dmp():
    time, position = arm_motion(n_samples=60, n_joints=3, moving_start=True)
    return JointDMP.fit(
        time,
        position,
        approach=0.5,
        scaling="amplitude",
        joint_names=NAMES,
        units="deg",
        basis=GaussianBasis(count=7, width=0.8),
        spring=SpringDamper(alpha=20.0),
    )


def test_the_same_coordinates_give_the_same_primitive(dmp):
    twin = dmp.with_coordinates(dmp.coordinates())
    assert twin.config() == dmp.config()
    assert twin.fit_report is None
    for name, tensor in dmp.state_dict().items():
        torch.testing.assert_close(twin.state_dict()[name], tensor, msg=name)


def test_coordinates_are_what_the_response_maps_to_the_motion(dmp):
    plain = JointDMP.fit(*arm_motion(n_samples=60, n_joints=3, moving_start=True), n_basis=7)
    H = plain.response.evaluate(plain.timestamps)[:, 0]
    torch.testing.assert_close(H @ plain.coordinates().mT, plain.rollout().position)


def test_nothing_is_shared_with_the_original(dmp):
    before = {name: tensor.clone() for name, tensor in dmp.state_dict().items()}
    twin = dmp.with_coordinates(dmp.coordinates())
    for tensor in twin.state_dict().values():
        tensor.zero_()
    for name, tensor in dmp.state_dict().items():
        torch.testing.assert_close(tensor, before[name], msg=name)


@pytest.mark.parametrize("batch", [(), (2,), (4, 1, 2)])
def test_the_batch_is_that_of_the_coordinates(dmp, batch):
    factor = 1 + torch.rand(*batch, 1, 1, generator=torch.Generator().manual_seed(0))
    x = factor * dmp.coordinates().detach()
    many = dmp.with_coordinates(x, duration=2.0 * dmp.duration)
    assert many.rollout().position.shape == (*batch, 60, 3)
    alone = dmp.with_coordinates(x.reshape(-1, *x.shape[-2:])[-1], 2.0 * dmp.duration)
    one = many.rollout().position.reshape(-1, 60, 3)[-1]
    torch.testing.assert_close(one, alone.rollout().position)
    torch.testing.assert_close(many.duration, (2 * dmp.duration).expand(batch))


def test_gradients_reach_coordinates_and_duration(dmp):
    x = dmp.coordinates().detach().requires_grad_()
    duration = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)

    def motion(x, duration):
        made = dmp.with_coordinates(x, duration)
        return made.rollout(time=[0.3, 1.7]).velocity

    assert torch.autograd.gradcheck(motion, (x, duration), atol=1e-6)
    assert not list(dmp.with_coordinates(x).parameters())


def test_weights_can_be_trained_where_nothing_is_to_be_passed_on(dmp):
    twin = dmp.with_coordinates(dmp.coordinates().detach())
    assert [name for name, _ in twin.named_parameters()] == ["weights"]


# What is kept between calls never outlives what it was made from


def fitted(seed=0):
    return JointDMP.fit(*arm_motion(n_samples=80, n_joints=2, seed=seed, moving_start=True), 12)


def rebuilt(dmp):
    """The motion of the same numbers, by the definition: no matrices, no caches."""
    rows = dmp.response.evaluate(dmp.timestamps.double())
    return (rows[:, 0] @ dmp.coordinates().double().mT).detach()


@pytest.mark.parametrize("name", ["weights", "start", "goal", "start_velocity", "timestamps"])
@pytest.mark.parametrize("how", ["in place", "data", "load", "new", "array"])
@pytest.mark.parametrize("derived", [True, False])
def test_a_change_shows_in_the_next_rollout(name, how, derived):
    with torch.set_grad_enabled(derived):
        check_that_a_change_shows(name, how)


def check_that_a_change_shows(name, how):
    dmp = fitted()
    before = dmp.rollout().position
    if how == "load":
        dmp.load_state_dict(dmp.state_dict() | {name: 0.9 * dmp.state_dict()[name]})
    elif how == "data":
        getattr(dmp, name).data.mul_(0.9)
    elif how == "new":  # a buffer becomes a parameter
        setattr(dmp, name, torch.nn.Parameter(0.9 * getattr(dmp, name).detach()))
    elif how == "array":
        getattr(dmp, name).detach().numpy()[...] *= 0.9
    else:
        with torch.no_grad():
            getattr(dmp, name).mul_(0.9)
    after = dmp.rollout().position
    assert (after - before).abs().max() > 1e-3
    torch.testing.assert_close(after, rebuilt(dmp))


def test_a_copy_goes_ways_of_its_own():
    dmp = fitted()
    with torch.no_grad():
        before = dmp.rollout().position
        other = copy.deepcopy(dmp)
        other.weights.mul_(0.9)
        torch.testing.assert_close(dmp.rollout().position, before, rtol=0, atol=0)
        torch.testing.assert_close(other.rollout().position, rebuilt(other))


def test_another_precision_shows_in_the_next_rollout():
    dmp = fitted()
    exact = dmp.rollout().position
    single = dmp.to(torch.float32).rollout().position
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), exact, rtol=0, atol=1e-4)
    assert dmp.to(torch.float64).rollout().position.dtype == torch.float64


def test_a_grid_changed_in_place_is_another_grid():
    dmp, time = fitted(), torch.linspace(0, 1, 30, dtype=torch.float64)
    _ = dmp.rollout(time).position
    time += 0.5
    fresh = dmp.rollout(time.clone()).position
    torch.testing.assert_close(dmp.rollout(time).position, fresh, rtol=0, atol=0)


def test_grids_and_primitives_take_turns():
    one, other = fitted(0), fitted(1)
    grids = [torch.linspace(0, end, 20, dtype=torch.float64) for end in (1.0, 2.0)]
    expected = [[dmp.rollout(grid).position for grid in grids] for dmp in (one, other)]
    for _ in range(2):
        for dmp, motions in zip((one, other), expected, strict=True):
            for grid, motion in zip(grids, motions, strict=True):
                torch.testing.assert_close(dmp.rollout(grid).position, motion, rtol=0, atol=0)


def test_no_matrix_holds_numbers_that_make_products_slow():
    """Subnormal ones, which the fading basis functions leave in single precision."""
    dmp = JointDMP.fit(*(column.float() for column in arm_motion(n_joints=2)), 50)
    for matrix in dmp.response.matrices(dmp.timestamps, torch.float32):
        size = matrix.abs()
        assert not ((size > 0) & (size < torch.finfo(torch.float32).tiny)).any()
    exact = dmp.response.evaluate(dmp.timestamps.double())[:, 0]
    position = dmp.response.matrices(dmp.timestamps, torch.float32)[0].mT.double()
    torch.testing.assert_close(position, exact, rtol=0, atol=1e-7)


def test_what_inference_leaves_behind_serves_a_backward_pass():
    """Tables, operators and matrices are shared by all primitives with the same parts."""
    with torch.inference_mode():
        fitted(1).rollout()
    dmp = fitted(1)
    step = dmp.step(dmp.initial_state(), 0.3)
    (dmp.rollout().position.sum() + step.position.sum()).backward()
    assert dmp.weights.grad is not None
    assert dmp.weights.grad.isfinite().all()


# Where nothing derives, NumPy does it: the same motions, and no others


ENDS = {
    "as demonstrated": {},
    "goal": {"goal": torch.tensor([0.3, -0.2], dtype=torch.float64)},
    "lists": {"start": [0.1, 0.2], "goal": [0.3, -0.2], "start_velocity": [0.5, -0.1]},
    "duration": {"duration": 1.3, "start_velocity": [0.5, -0.1]},
    "parameter": {"goal": torch.nn.Parameter(torch.tensor([0.3, -0.2], dtype=torch.float64))},
    "one for two": {"goal": torch.zeros(1, 2, dtype=torch.float64)},
    "gain": {"forcing_gain": 0.5},
}


@pytest.mark.parametrize("ends", ENDS.values(), ids=ENDS.keys())
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_rollout_is_the_same_with_and_without_gradients(ends, dtype):
    dmp = fitted().to(dtype)
    for time in (None, torch.linspace(0, 2, 17)):
        derived = dmp.rollout(time, **ends)
        for inference in (False, True):
            with torch.inference_mode(inference), torch.no_grad():
                plain = dmp.rollout(time, **ends)
                for name in ("time", "position", "velocity", "acceleration", "jerk"):
                    # The digits that sums of fifteen products leave, of the largest.
                    expected = getattr(derived, name).detach()
                    atol = 100 * torch.finfo(dtype).eps * expected.abs().max().item()
                    actual = getattr(plain, name)
                    torch.testing.assert_close(actual, expected, rtol=0, atol=atol)


def test_a_rollout_without_gradients_leaves_those_of_the_next_alone():
    dmp = fitted()
    with torch.no_grad():
        assert not dmp.rollout().position.requires_grad
    dmp.rollout().position.sum().backward()
    assert dmp.weights.grad.abs().max() > 0


def test_what_is_read_later_is_of_when_it_was_asked_for():
    dmp = fitted()
    with torch.no_grad():
        expected, motion = dmp.rollout().position, dmp.rollout()
        dmp.weights.mul_(0.5)
    torch.testing.assert_close(motion.position, expected, rtol=0, atol=1e-12)


def test_ends_that_are_wrong_are_named_without_gradients_too():
    dmp = fitted()
    with torch.no_grad():
        with pytest.raises(ValueError, match="goal must be finite"):
            dmp.rollout(goal=[0.0, float("nan")])
        with pytest.raises(ValueError, match=r"start must have shape \(\.\.\., 2\)"):
            dmp.rollout(start=[0.0, 1.0, 2.0])
        with pytest.raises(ValueError, match="start_velocity must be finite"):
            dmp.rollout(start_velocity=[float("inf"), 0.0])


def test_transforms_see_through_rollouts_without_gradients():
    """`no_grad` stops neither `vmap` nor derivatives forwards."""
    dmp = fitted()
    goals = torch.tensor([[0.3, -0.2], [0.1, 0.4], [0.0, 0.0]], dtype=torch.float64)

    def position(goal):
        return dmp.rollout(goal=goal).position

    with torch.no_grad():
        expected = torch.stack([position(goal) for goal in goals])
        torch.testing.assert_close(torch.vmap(position)(goals), expected)
        _, change = torch.func.jvp(position, (goals[0],), (torch.ones_like(goals[0]),))
        with forward_ad.dual_level():
            dual = forward_ad.make_dual(goals[0], torch.ones_like(goals[0]))
            tangent = forward_ad.unpack_dual(position(dual)).tangent
    moved = (position(goals[0] + 1) - position(goals[0])).detach()  # linear in the goal
    torch.testing.assert_close(change, moved)
    torch.testing.assert_close(tangent, moved)


def test_the_first_rollout_may_be_inside_a_transform():
    """Its grid has no matrices yet, and none can be made there."""
    time, position = arm_motion(n_samples=61, n_joints=2)
    dmp = JointDMP.fit(time, position, 9)
    moved = dmp.with_coordinates(dmp.coordinates().detach(), timestamps=dmp.timestamps / 2)
    tangent = torch.ones(2, dtype=torch.float64)

    def end(goal):
        return moved.rollout(goal=goal).position[-1]

    _, change = torch.func.jvp(end, (dmp.goal,), (tangent,))
    torch.testing.assert_close(change, (end(dmp.goal + 1) - end(dmp.goal)).detach())


def test_swapped_parameters_are_those_that_move():
    dmp = fitted()
    other = {"weights": 0.5 * dmp.weights.detach(), "goal": dmp.goal + 0.1}
    with torch.no_grad():
        before = dmp.rollout().position
        swapped = torch.func.functional_call(
            Rolling(dmp), {f"dmp.{k}": other[k] for k in other}
        )
        torch.testing.assert_close(dmp.rollout().position, before, rtol=0, atol=0)
        for name, value in other.items():
            getattr(dmp, name).copy_(value)
    torch.testing.assert_close(swapped, rebuilt(dmp))


class Rolling(torch.nn.Module):
    """A primitive's rollout as a module's `forward`."""

    def __init__(self, dmp):
        super().__init__()
        self.dmp = dmp

    def forward(self):
        return self.dmp.rollout().position


def test_threads_share_a_primitive():
    dmp = fitted()
    grids = [torch.linspace(0, 1 + k, 20 + k, dtype=torch.float64) for k in range(4)]
    goals = [torch.full((2,), 0.1 * k, dtype=torch.float64) for k in range(4)]

    @torch.no_grad()
    def position(k):
        return dmp.rollout(grids[k % 4], goal=goals[k % 4]).position

    expected = [position(k) for k in range(4)]
    with ThreadPoolExecutor(4) as threads:
        for k, made in enumerate(threads.map(position, range(400))):
            torch.testing.assert_close(made, expected[k % 4], rtol=0, atol=0)


@pytest.mark.parametrize("n_threads", [1, 2])
@pytest.mark.parametrize("most", [0, 10**6])
@pytest.mark.parametrize("shape", [(), (1,), (5,), (2, 3)])
def test_every_way_to_multiply_gives_the_same_motions(monkeypatch, shape, most, n_threads):
    """In NumPy motion by motion, in PyTorch all at once, and as gradients need it."""
    time, position = arm_motion(n_samples=80)
    positions = position + torch.randn(*shape, 1, 7, dtype=torch.float64)
    dmp = JointDMP.fit(time, positions, 12)
    derived = dmp.rollout()
    for module in (response, trajectory):
        monkeypatch.setattr(module, "numpy_limit", lambda: most)
    before = torch.get_num_threads()
    torch.set_num_threads(n_threads)
    try:
        with torch.no_grad():
            motion = dmp.rollout()
            for name in ("position", "velocity", "acceleration"):
                torch.testing.assert_close(
                    getattr(motion, name), getattr(derived, name).detach()
                )
            for i in np.ndindex(shape) if shape else ():
                torch.testing.assert_close(motion.position[i], dmp[i].rollout().position)
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize(
    ("libraries", "most"),
    [
        ([("openmp", None), ("openblas", "SkylakeX")], 10**6),
        ([("openblas", "Haswell")], 10**5),
        ([("openmp", None)], 10**5),
    ],
)
def test_numpy_multiplies_what_its_library_has_kernels_for(monkeypatch, libraries, most):
    found = [{"internal_api": api, "architecture": name} for api, name in libraries]
    monkeypatch.setattr("threadpoolctl.threadpool_info", lambda: found)
    assert response.numpy_limit.__wrapped__() == most


@pytest.mark.parametrize("shape", [(3, 5), (2, 3, 5), (2, 4, 5)])
def test_parameters_are_multiplied_where_nothing_derives_them(shape):
    X, H = torch.nn.Parameter(torch.randn(*shape)), torch.randn(5, 6)
    with torch.no_grad():
        torch.testing.assert_close(response.product(X, H), X.detach() @ H)

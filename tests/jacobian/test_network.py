import json

import numpy as np
import pytest
import torch
from pinhole import wander
from safetensors.torch import load_file, save_file
from sampling import generator
from torch.testing import assert_close

from hrc_learn.jacobian import RBFImageJacobian, grid, paper_grid
from hrc_learn.jacobian.perspective import CameraFit

# (eq_js0): the paper's first guess.
J0 = torch.tensor(
    [[-1500, 0, 0, 0, -200, 60], [0, 2400, 170, -200, 0, 180]], dtype=torch.float64
)


def random_network(seed=0, *, normalized=True, input_indices=(0, 1), K=7):
    rng = generator(seed)
    n = len(input_indices)
    centers = 0.3 + 0.2 * torch.randn(K, n, generator=rng, dtype=torch.float64)
    weight = 1000 * torch.randn(12, K, generator=rng, dtype=torch.float64)
    return RBFImageJacobian(
        centers, 0.15, weight=weight, input_indices=input_indices, normalized=normalized
    )


def pose_vectors(*batch, seed=1):
    r = torch.randn(*batch, 6, generator=generator(seed), dtype=torch.float64)
    return 0.3 * r + 0.3


@pytest.mark.parametrize("normalized", [True, False])
@pytest.mark.parametrize("input_indices", [(0, 1), (0, 1, 2), (2, 5)])
@pytest.mark.parametrize("batch", [(), (1,), (3, 1, 2)])
def test_is_the_sum_over_neurons(batch, input_indices, normalized):
    """Entry by entry, as (approxNN) defines it: j_ij of J_s^T is w_ij . theta."""
    network = random_network(normalized=normalized, input_indices=input_indices)
    r = pose_vectors(*batch)
    J = network(r)
    assert J.shape == (*batch, 2, 6)
    W = network.weight.detach().unflatten(0, (2, 6))  # rows of vec(J_s^T)
    for index in np.ndindex(batch):
        x = r[index][list(input_indices)]
        theta = [
            torch.exp(-((x - c) ** 2).sum() / (2 * 0.15**2)).item() for c in network.centers
        ]
        total = sum(theta) if normalized else 1.0
        for i in range(6):
            for j in range(2):
                entry = sum(W[j, i, k].item() * theta[k] / total for k in range(7))
                assert J[(*index, j, i)].item() == pytest.approx(entry, rel=1e-9)


def test_vec_stacks_the_columns_of_the_transpose():
    """(reformulation): xi_x' vec(J^T) = J^T xi_x with xi_x' = [xi_1 I, xi_2 I]."""
    network = random_network()
    r, xi = pose_vectors(), torch.tensor([0.7, -0.3], dtype=torch.float64)
    vec = network.weight @ network.basis(r)
    eye = torch.eye(6, dtype=torch.float64)
    assert_close(torch.cat([xi[0] * eye, xi[1] * eye], dim=-1) @ vec, network(r).mT @ xi)


def test_a_pose_is_its_vector():
    network = random_network(input_indices=(0, 2, 4))
    pose = wander(5, rng=generator(2))
    assert_close(network(pose), network(pose.vector()))


def test_from_jacobian_holds_everywhere():
    network = RBFImageJacobian.from_jacobian(J0, paper_grid(), 0.1)
    far = torch.tensor([[0.2, 0.5, 0, 0, 0, 0], [9.0, -7, 3, 1, 1, 1]], dtype=torch.float64)
    assert_close(network(far), J0.expand(2, 2, 6))


def test_paper_grid_is_table_one():
    expected = [[0.05 + 0.15 * i, 0.35 + 0.15 * j] for i in range(3) for j in range(3)]
    assert_close(paper_grid(), torch.tensor(expected, dtype=torch.float64))
    assert grid((0.0, 1.0, 4)).shape == (4, 1)


def test_normalised_neurons_sum_to_one_even_far_away():
    network = random_network()
    r = 1e3 * pose_vectors(50)
    assert_close(network.basis(r).sum(-1), torch.ones(50, dtype=torch.float64))


def test_gradients():
    network = random_network()
    r = pose_vectors(3).requires_grad_()

    def by_weight(weight, r):
        return torch.func.functional_call(network, {"weight": weight}, (r,))

    assert torch.autograd.gradcheck(by_weight, (network.weight, r))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"input_indices": (0, 1, 2)}, "2 columns"),
        ({"input_indices": (0, 6)}, "components 0 to 5"),
        ({"width": 0.0}, "width must be positive"),
        ({"width": float("inf")}, "width must be positive and finite, got inf"),
    ],
)
def test_nonsense_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        RBFImageJacobian(paper_grid(), **({"width": 0.1} | arguments))


def test_save_and_load(tmp_path):
    network = random_network(normalized=False, input_indices=(1, 2, 5))
    network.save(tmp_path / "model")
    loaded = RBFImageJacobian.load(tmp_path / "model")
    r = pose_vectors(4)
    assert_close(loaded(r), network(r), rtol=0, atol=0)
    assert loaded.input_indices == (1, 2, 5)
    assert not loaded.normalized


def test_save_replaces_an_older_save_and_leaves_nothing_else(tmp_path):
    folder = tmp_path / "model"
    random_network(1).save(folder)
    newer = random_network(2)
    newer.save(folder)
    assert_close(RBFImageJacobian.load(folder).weight, newer.weight)
    assert [path.name for path in tmp_path.iterdir()] == ["model"]
    assert sorted(path.name for path in folder.iterdir()) == [
        ".manifest.json",
        "config.json",
        "model.safetensors",
    ]


def test_save_refuses_a_folder_of_something_else(tmp_path):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").write_text("words")
    with pytest.raises(ValueError, match="choose another"):
        random_network().save(tmp_path / "thesis")
    assert (tmp_path / "thesis" / "chapter.tex").read_text() == "words"


def test_a_saved_camera_of_another_size_is_refused(tmp_path):
    fit = CameraFit(camera=torch.zeros(13), covariance=torch.eye(13), noise=1.0)
    RBFImageJacobian(paper_grid(), 0.1, camera=fit).save(tmp_path / "model")
    assert RBFImageJacobian.load(tmp_path / "model").camera is not None
    file = tmp_path / "model" / "model.safetensors"
    tensors = load_file(file)
    save_file(tensors | {"camera": tensors["camera"][:12].clone()}, file)
    (tmp_path / "model" / ".manifest.json").unlink()
    with pytest.raises(ValueError, match=r"must have 13 rows, but have shapes \(12,\) and"):
        RBFImageJacobian.load(tmp_path / "model")


def test_a_network_without_a_fit_has_no_uncertainty():
    with pytest.raises(ValueError, match="without a fit has no uncertainty: fit it to"):
        random_network().uncertainty(pose_vectors(1))


def test_load_names_what_is_wrong(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"config\.json does not exist"):
        RBFImageJacobian.load(tmp_path / "nowhere")
    folder = tmp_path / "model"
    random_network().save(folder)
    (folder / ".manifest.json").unlink()
    config = json.loads((folder / "config.json").read_text())

    (folder / "config.json").write_text(json.dumps(config | {"version": 99}))
    with pytest.raises(ValueError, match="version is 99"):
        RBFImageJacobian.load(folder)
    (folder / "config.json").write_text(json.dumps(config | {"input_indices": [0, 1, 2]}))
    with pytest.raises(ValueError, match=r"model: .*2 columns"):
        RBFImageJacobian.load(folder)
    (folder / "config.json").write_text("{")
    with pytest.raises(ValueError, match="not valid JSON"):
        RBFImageJacobian.load(folder)
    (folder / "config.json").write_text(json.dumps(config))
    (folder / "model.safetensors").write_bytes(b"nothing")
    with pytest.raises(ValueError, match="not a safetensors file"):
        RBFImageJacobian.load(folder)


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_the_first_pixel_is_that_of_a_pinhole_at_every_pose(batch):
    """Focal length 500 px, the camera above the origin looks down, no lens, no offset."""
    camera = torch.tensor([np.log(500.0), 320, 240, 0, np.pi, 0, 0, 0, 0, 1.5, 0, 0, 0])
    network = random_network()
    network.camera = camera.double()
    r = pose_vectors(*batch)
    pixel = network.first_pixel(r)
    assert pixel.shape == (*batch, 2)
    for index in np.ndindex(batch):
        x, y, z = r[index][:3].tolist()
        # Half a turn about x: y and z change their signs, the camera is at a height of 1.5 m.
        expected = [320 + 500 * x / (1.5 - z), 240 - 500 * y / (1.5 - z)]
        np.testing.assert_allclose(pixel[index], expected, atol=1e-6)


def test_without_a_camera_there_is_no_first_pixel():
    assert random_network().first_pixel(pose_vectors(2)) is None

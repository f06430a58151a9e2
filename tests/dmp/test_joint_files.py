import json

import pytest
import torch
from demo_motions import arm_motion
from power_cuts import cut_off
from safetensors.torch import load_file, save_file

from hrc_learn.dmp import JointDMP

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
    assert sorted(p.name for p in folder.iterdir()) == ["config.json", "model.safetensors"]
    assert [p.name for p in folder.parent.iterdir()] == ["primitive"]


def test_saving_replaces_no_model_of_another_program(tmp_path):
    """Many programs name their files so; only the contents tell whose they are."""
    (tmp_path / "bert").mkdir()
    (tmp_path / "bert" / "config.json").write_text('{"architectures": ["BERT"]}')
    (tmp_path / "bert" / "model.safetensors").write_bytes(b"weeks of training")
    with pytest.raises(ValueError, match="not ours to overwrite"):
        JointDMP.fit(TIME, POSITION).save(tmp_path / "bert")
    assert (tmp_path / "bert" / "model.safetensors").read_bytes() == b"weeks of training"


def test_saving_replaces_no_model_with_notes_beside_it(saved):
    _, folder = saved
    (folder / "notes.txt").write_text("good with the blue gripper")
    with pytest.raises(ValueError, match=r"holds more than a saved model, notes\.txt"):
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
    with pytest.raises(ValueError, match="not ours to overwrite"):
        JointDMP.fit(TIME, POSITION).save(tmp_path / "thesis")
    assert (tmp_path / "thesis" / "chapter.tex").read_text() == "years of work"


@pytest.mark.parametrize(
    ("field", "value", "complaint"),
    [
        ("version", 2, "config.json: version is 2, this reads 1"),
        ("kind", "Cake", "config.json: kind is 'Cake', this reads 'JointDMP'"),
        ("scaling", None, "config.json: field 'scaling' must be str, got None"),
        ("scaling", "cubic", "unknown scaling 'cubic'"),
        ("spring", {"alpha": -1.0}, "alpha must be positive"),
        ("basis", {"count": 8}, r"config\.json: field 'basis': 'type' is missing"),
        ("basis", {"type": "Wavelets"}, "field 'basis': unknown type 'Wavelets'"),
        ("spring", {"gamma": 1.0}, "field 'spring': .*gamma"),
        ("approach", 2.0, "approach must be a share"),
        ("joint_names", ["only"], "1 joint names for 2"),
    ],
)
def test_a_wrong_config_names_file_and_field(saved, field, value, complaint):
    _, folder = saved
    path = folder / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {field: value}))
    with pytest.raises(ValueError, match=complaint) as error:
        JointDMP.load(folder)
    assert str(folder) in str(error.value)


def test_a_missing_field_or_file_is_named(saved):
    _, folder = saved
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
    tensors = load_file(folder / "model.safetensors")
    change(tensors)
    save_file(tensors, folder / "model.safetensors")
    with pytest.raises(ValueError, match=complaint) as error:
        JointDMP.load(folder)
    assert str(folder) in str(error.value)

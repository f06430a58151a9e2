"""A kind of folder to write, and what it holds."""

from pathlib import Path

from hrc_learn.store import MANIFEST, Kind, replacing

KIND = Kind(name="cake")
EXTENDED = Kind(name="cake", files=("mark", "result", "layers/*"))


class WorkFailedError(Exception):
    pass


def fill(path, text: str, overwrite: bool = False, kind: Kind = KIND) -> None:
    with replacing(path, kind, overwrite) as folder:
        (folder / "layers").mkdir(parents=True)
        (folder / "mark").touch()
        (folder / "result").write_text(text)
        (folder / "layers" / text).touch()


def fail_to_fill(path: Path, error: type[BaseException]) -> None:
    with replacing(path, KIND, overwrite=True) as folder:
        folder.mkdir()
        (folder / "result").write_text("half")
        raise error


def contents(path: Path) -> dict[str, str]:
    """All files below a folder, hidden ones too, but manifests, by their relative path."""
    return {
        str(file.relative_to(path)): file.read_text()
        for file in path.rglob("*")
        if file.is_file() and file.name != MANIFEST
    }


def cake(text: str, name: str = "out") -> dict[str, str]:
    return {f"{name}/mark": "", f"{name}/result": text, f"{name}/layers/{text}": ""}

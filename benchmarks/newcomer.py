"""A newcomer's first hour, typed step by step: what each step answers and how long it takes.

    python benchmarks/newcomer.py [--against FOLDER] [--out FILE.json]

In an empty folder lie a PSF and a photograph, raw 16-bit TIFFs of 270 x 480 pixels (SIMULATED). Steps are
what somebody types who has read nothing but the README: in the terminal, and in Python. Each runs in a
process of its own, starting included; kernels are compiled before. ``--against`` types the same at another
checkout (``git worktree add FOLDER COMMIT``). "Worked" is status 0 and the file that was asked for.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

NOT_THE_INSTALLED_ONE = (
    "import sys\n"
    "sys.meta_path = [f for f in sys.meta_path if 'editable' not in getattr(f, '__module__', '')]\n"
)
"""An editable installation's modules would stand in for those that another checkout lacks."""

RIDGE = """
class Ridge(db.Prior):
    def value(self, x): return float((x * x).sum()) / 2
    def prox(self, x, step): return x / (1 + step)
"""


class Step(NamedTuple):
    """What is typed, and the file that is to be there afterwards."""

    what: str
    typed: str
    file: str = ""


STEPS = (
    Step("what is there?", "diffuserbench"),
    Step("files without options", "diffuserbench reconstruct psf.tif photo.tif"),
    Step(
        "first picture of one's own files",
        "diffuserbench reconstruct --psf psf.tif --image photo.tif --out scene.tif",
        "scene.tif",
    ),
    Step(
        "another prior, with a page",
        "diffuserbench reconstruct --psf psf.tif --image photo.tif --prior l1 --figure page.png --out l1.tif",
        "page.png",
    ),
    Step("a photograph on the bench", "diffuserbench snap --out snap.tif", "snap.tif"),
    Step("a dark frame for it", "diffuserbench snap --dark --out dark.tif", "dark.tif"),
    Step("the mask of a display", "diffuserbench align mask"),
    Step("does it work here?", "diffuserbench test"),
    Step("Python: the import", "import diffuserbench as db"),
    Step(
        "Python: first picture of one's own files",
        "import diffuserbench as db\ndb.reconstruct('photo.tif', 'psf.tif').save('py.png')",
        "py.png",
    ),
    Step(
        "Python: a prior of one's own",
        f"import diffuserbench as db\n{RIDGE}\n"
        "mine = db.reconstruct('photo.tif', 'psf.tif', prior=Ridge() + db.NonNegativity(), iterations=50)\n"
        "mine.save('mine.png')",
        "mine.png",
    ),
    Step(
        "Python: an operator composed",
        "import numpy as np, diffuserbench as db\n"
        "A = db.Convolution(np.ones((1, 8, 8), np.float32), (8, 8))\n"
        "x = np.ones(A.domain_shape, np.float32)\n(2 * A + A)(x), A.H(A(x))",
    ),
)


def write_files(folder: Path) -> None:
    """Write the newcomer's PSF and photograph."""
    from instrument.files.images import write_image
    from recon.evaluation.scene import make_scene

    scene = make_scene("dense-picture", size=(270, 480))
    for name, image in (("photo", scene.measurement), ("psf", scene.calibration.psfs[0, 0])):
        raw = 100 + 40_000 * np.clip(image, 0, None) / np.max(image)
        write_image(folder / f"{name}.tif", raw.astype(np.uint16))


def carry_out(step: Step, folder: Path, checkout: Path) -> dict[str, object]:
    """Type a step in a folder; return whether it worked, its seconds and what it said last."""
    if step.typed.startswith("diffuserbench"):
        words = step.typed.split()[1:]
        code = f"import sys; from instrument.cli import main; sys.exit(main({words!r}))"
    else:
        code = step.typed
    code = f"{NOT_THE_INSTALLED_ONE}{code}"
    environment = os.environ | {"PYTHONPATH": str(checkout), "MPLBACKEND": "agg"}
    began_s, cpu = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    said = [line for line in (done.stdout + done.stderr).splitlines() if line.strip()]
    return {
        "step": step.what,
        "worked": done.returncode == 0 and (not step.file or (folder / step.file).exists()),
        "status": done.returncode,
        "seconds": round(time.monotonic() - began_s, 1),
        "cpu_seconds": round(resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - cpu, 1),
        "said": said[-1][:160].strip() if said else "",
    }


def main() -> None:
    """Type all steps and print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--against", type=Path, default=ROOT, metavar="FOLDER")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    found = []
    print("| step | worked | s | CPU s | said last |\n|---|---|---|---|---|")
    checkout = arguments.against.resolve()
    with tempfile.TemporaryDirectory() as scratch, tempfile.TemporaryDirectory() as warm:
        for folder in map(Path, (warm, scratch)):
            write_files(folder)
        for step in STEPS[2:4]:
            carry_out(step, Path(warm), checkout)
        for step in STEPS:
            row = carry_out(step, folder, checkout)
            found.append(row)
            worked = "yes" if row["worked"] else "no"
            cells = (row["step"], worked, row["seconds"], row["cpu_seconds"], row["said"])
            print(f"| {' | '.join(map(str, cells))} |")
            sys.stdout.flush()
    if arguments.out:
        arguments.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()

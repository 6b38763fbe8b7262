"""Draw the three charts of README and docs/benchmarks/charts.md: reconstructions, holograms, calibrations.

    python benchmarks/charts.py [--only hologram] [--budget 900] [--work charts]

Runs ``diffuserbench chart`` three times. What it has computed is kept in the work folder, so that an
interrupted run goes on; delete the folder to measure anew.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
IMAGES = ROOT / "docs" / "images"
CHARTS = {
    "reconstruction": ["scene", "sparse-picture", "--size", "96"],
    "hologram": ["hologram", "portrait", "--slm", "135x240"],
    "calibration": ["calibrations"],
}


def main() -> None:
    """Run the commands and put the pictures into the documentation."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", choices=list(CHARTS))
    parser.add_argument("--budget", type=float, default=900.0, help="seconds for each chart")
    parser.add_argument("--work", type=Path, default=ROOT / "charts")
    options = parser.parse_args()
    program = Path(sys.executable).with_name("diffuserbench")
    for name, arguments in CHARTS.items():
        if options.only in (None, name):
            folder = options.work / name
            command = [program, "chart", *arguments, "--budget", f"{options.budget:g}", "--out", folder]
            subprocess.run([str(part) for part in command], check=True)
            shutil.copyfile(folder / "chart.png", IMAGES / f"chart-{name}.png")


if __name__ == "__main__":
    main()

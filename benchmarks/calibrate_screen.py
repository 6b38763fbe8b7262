"""A PSF from photographs of known pictures, on seven measured pairs (LenslessLearning, Waller Lab).

Each of the seven is reconstructed, by default options, with the PSF that the other six give, and compared
with its picture: PSNR over the whole field for a peak of 1, after the best shift by whole pixels and the
best gain and offset a channel. "Before": the best that was known, non-negative least squares with a weight
of total variation chosen by hand. The data are not part of the repository (`DIFFUSERBENCH_DATA`, or
`../shared/data`).

    python benchmarks/calibrate_screen.py --out docs/benchmarks/calibrate_screen.jpg
    python benchmarks/calibrate_screen.py --bin 2
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import cv2
import numpy as np

from recon.base.blocks import block_mean
from recon.base.threads import set_threads
from recon.blind.left_out import LeftOut, leave_out
from recon.evaluation.measured_sets import measured_pairs

BEFORE_DB = {"157": 14.9, "189": 15.3, "394": 18.2, "408": 14.8, "43": 16.5, "643": 17.6, "65": 16.6}


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bin", type=int, default=1, help="binning of photographs and pictures")
    parser.add_argument("--only", nargs="*", help="names of the pairs to leave out; default all")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, help="figure of the reconstructions beside their pictures")
    arguments = parser.parse_args()
    set_threads(arguments.threads)
    names, photographs, pictures = measured_pairs()
    print("| picture | even | before, dB | now, dB | CPU s |\n|---|---|---|---|---|", flush=True)
    found: list[LeftOut] = []
    for name in arguments.only or names:
        start = time.process_time()
        found += leave_out(photographs, pictures, names, only=[name], binning=arguments.bin)
        one = found[-1]
        seconds = time.process_time() - start
        row = f"{name} | {one.flat_db:.1f} | {BEFORE_DB[name]:.1f} | {one.psnr_db:.2f} | {seconds:.0f}"
        print(f"| {row} |", flush=True)
    before = np.mean([BEFORE_DB[one.name] for one in found])
    print(f"| mean | | {before:.1f} | {np.mean([one.psnr_db for one in found]):.2f} | |")
    if arguments.out:
        shown = block_mean(pictures, arguments.bin, about_axis=True)
        draw([(shown[names.index(one.name)], one) for one in found], arguments.out)


def draw(found: list[tuple[np.ndarray, LeftOut]], out: Path) -> None:
    """Write pictures above, reconstructions below."""
    columns = [np.vstack([np.moveaxis(picture, 0, -1), np.clip(one.image, 0, 1)]) for picture, one in found]
    sheet = np.hstack(columns) ** (1 / 1.5)
    scale = min(1.0, 1900 / sheet.shape[1])
    shown = cv2.resize(sheet[..., ::-1], None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(out), np.asarray(255 * np.clip(shown, 0, 1), np.uint8))


if __name__ == "__main__":
    main()

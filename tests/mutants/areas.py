"""What is changed, and the tests that are to notice."""

from __future__ import annotations

from pathlib import Path

_ROOT = Path(__file__).parents[2]


def _all_of(folder: str, *, but: tuple[str, ...] = ()) -> tuple[str, ...]:
    """Return every module of a folder, those of next week too; not compiled kernels, nor those of ``but``."""
    names = sorted(file.name for file in (_ROOT / folder).glob("[!_]*.py"))
    return tuple(f"{folder}/{name}" for name in names if name not in but)


_RUNS = tuple(
    f"tests/instrument/runs/test_{name}.py"
    for name in (
        "acquire",
        "acquisition_simulated",
        "damage",
        "export",
        "fault_injection",
        "finish",
        "frame_facts",
        "frame_metadata",
        "imported",
        "inspection",
        "interrupt",
        "log",
        "looked_at",
        "pace",
        "recorder",
        "recorder_in_pieces",
        "recording_rest",
        "repair",
        "resume",
        "run_by_its_files",
        "run_control",
        "runner",
        "runner_in_pieces",
        "store",
        "store_in_pieces",
        "store_order",
        "timed",
    )
)
"""Not test_signals.py: its programs are processes of their own."""
_RUNNER = ("acquire.py", "pace.py", "recorder.py", "rehearsal.py", "run_control.py", "runner.py", "timed.py")
_STREAM = ("buffered_camera.py", "running_camera.py", "stream.py", "stream_reader.py")
_CHECKED = ("answers.py", "checked.py", "framing.py", "polled_stage.py", "serial_transport.py")
AREAS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "safety": (
        (
            "instrument/bench/safety.py",
            "instrument/bench/bench.py",
            "instrument/bench/source_and_scene.py",
            *(f"drivers/common/{name}" for name in _CHECKED),
        ),
        (
            "tests/instrument/bench/test_bench_safety.py",
            "tests/instrument/bench/test_source_and_scene.py",
            "tests/instrument/bench/test_closing_at_exit.py",
            "tests/instrument/bench/test_bench_lock.py",
            "tests/drivers/test_answers.py",
            "tests/drivers/test_checked.py",
            "tests/drivers/test_polled_stage.py",
            "tests/drivers/test_serial_transport.py",
            "tests/drivers/test_simulated_faults.py",
            "tests/instrument/runs/test_acquisition_simulated.py",
            "tests/instrument/runs/test_timed.py",
        ),
    ),
    "runner": (
        tuple(f"instrument/runs/{name}" for name in _RUNNER),
        (
            *_RUNS,
            "tests/drivers/test_answers.py",
            "tests/calibration_routines/test_procedures.py",
            "tests/instrument/test_cli_acquisition.py",
        ),
    ),
    "store": (
        (
            *_all_of("instrument/runs", but=_RUNNER),
            "instrument/files/atomic.py",
            "instrument/files/record.py",
        ),
        (
            *_RUNS,
            "tests/instrument/files/test_atomic.py",
            "tests/instrument/files/test_record.py",
            "tests/instrument/test_result_record.py",
            "tests/instrument/test_cli_acquisition.py",
        ),
    ),
    "drops": (("drivers/common/drops.py",), ("tests/drivers/test_drops.py",)),
    "streams": (
        (
            *(f"drivers/common/{name}" for name in _STREAM),
            *_all_of("recon/streams"),
            *_all_of("instrument/live"),
        ),
        (
            "tests/drivers/test_stream.py",
            "tests/drivers/test_buffered_camera.py",
            "tests/drivers/test_answers.py",
            "tests/drivers/test_aravis.py",
            "tests/drivers/test_basler.py",
            "tests/drivers/test_micromanager.py",
            "tests/drivers/test_simulated_contracts.py",
            "tests/drivers/test_v4l2.py",
            "tests/recon/video",
            "tests/recon/activity",
            "tests/recon/live",
            "tests/instrument/live",
            "tests/instrument/video",
            "tests/golden/test_golden.py",
        ),
    ),
    "units": (
        (
            *_all_of("drivers/common", but=("drops.py", *_STREAM, *_CHECKED)),
            "drivers/apt/drives.py",
            "drivers/grbl/settings.py",
            "drivers/zaber/stage.py",
            "drivers/smc100/stage.py",
            "drivers/elliptec/stage.py",
            "recon/base/noise.py",
        ),
        (
            "tests/drivers/test_cache.py",
            "tests/drivers/test_camera_settings.py",
            "tests/drivers/test_drives.py",
            "tests/drivers/test_stage_axes.py",
            "tests/drivers/test_port_stages.py",
            "tests/drivers/test_pixels.py",
            "tests/drivers/test_simulated_contracts.py",
            "tests/drivers/test_apt.py",
            "tests/drivers/test_grbl.py",
            "tests/drivers/test_grbl_protocol.py",
            "tests/drivers/test_zaber.py",
            "tests/drivers/test_aravis.py",
            "tests/drivers/test_micromanager.py",
            "tests/drivers/test_raspberry.py",
            "tests/recon/test_bayer_and_noise.py",
        ),
    ),
    "solvers": (
        (
            *_all_of("recon/solvers"),
            *_all_of("recon/priors"),
            "recon/base/filling.py",
        ),
        (
            "tests/recon/solvers",
            "tests/recon/priors",
            "tests/recon/base/test_filling.py",
            "tests/golden/test_golden.py",
        ),
    ),
    "operators": (
        _all_of("recon/camera", but=("vignetting.py",)),
        (
            "tests/recon/analysis/test_point_places.py",
            "tests/recon/auto/test_auto_rules.py",
            "tests/recon/camera",
            "tests/recon/reconstruction/test_fitted_places.py",
            "tests/recon/reconstruction/test_planes_beyond.py",
            "tests/recon/blind/test_points.py",
            "tests/recon/test_bayer_and_noise.py",
            "tests/recon/test_patterned.py",
            "tests/golden/test_golden.py",
        ),
    ),
    "photographs": (
        (
            "instrument/reconstruction/matching.py",
            "recon/base/shared_lines.py",
            "recon/camera/vignetting.py",
            "recon/reconstruction/background.py",
            "recon/reconstruction/mending/restored_light.py",
            "recon/reconstruction/planes.py",
        ),
        (
            "tests/instrument/test_matching.py",
            "tests/recon/auto",
            "tests/recon/base/test_shared_lines.py",
            "tests/recon/camera/test_vignetting_numbers.py",
            "tests/recon/reconstruction/test_background_of_pictures.py",
            "tests/recon/reconstruction/test_dark_offset.py",
            "tests/recon/reconstruction/test_background_rules.py",
            "tests/recon/reconstruction/test_planes_beyond.py",
            "tests/recon/reconstruction/test_vignetting.py",
        ),
    ),
    "verdict": (
        _all_of("recon/verdict"),
        (
            "tests/recon/verdict",
            "tests/recon/evaluation/test_failure.py",
            "tests/recon/evaluation/test_map.py",
            "tests/recon/evaluation/test_shipped.py",
        ),
    ),
}
"""Of each area its modules, and its tests; a test may notice a change in any area."""

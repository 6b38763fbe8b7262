"""What is changed, and the tests that are to notice."""

from __future__ import annotations

_RUNS = tuple(
    f"tests/instrument/runs/test_{name}.py"
    for name in (
        "acquisition_simulated",
        "damage",
        "fault_injection",
        "frame_metadata",
        "interrupt",
        "recorder",
        "resume",
        "runner",
        "store",
        "store_order",
        "timed",
    )
)
"""Not test_signals.py: its programs are processes of their own."""
AREAS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "safety": (
        (
            "instrument/bench/safety.py",
            "instrument/bench/bench.py",
            "instrument/bench/source_and_scene.py",
            "drivers/common/answers.py",
            "drivers/common/checked.py",
        ),
        (
            "tests/instrument/bench/test_bench_safety.py",
            "tests/instrument/bench/test_closing_at_exit.py",
            "tests/instrument/bench/test_bench_lock.py",
            "tests/drivers/test_answers.py",
            "tests/drivers/test_checked.py",
            "tests/drivers/test_simulated_faults.py",
            "tests/instrument/runs/test_acquisition_simulated.py",
            "tests/instrument/runs/test_timed.py",
        ),
    ),
    "runner": (
        (
            "instrument/runs/runner.py",
            "instrument/runs/run_control.py",
            "instrument/runs/recorder.py",
            "instrument/runs/acquire.py",
            "instrument/runs/timed.py",
        ),
        (*_RUNS, "tests/drivers/test_answers.py"),
    ),
    "store": (
        (
            "instrument/runs/writer.py",
            "instrument/runs/log.py",
            "instrument/runs/run_files.py",
            "instrument/runs/run.py",
            "instrument/runs/repair.py",
            "instrument/runs/finish.py",
            "instrument/runs/frame_array.py",
            "instrument/runs/inspection.py",
            "instrument/files/atomic.py",
            "instrument/files/record.py",
        ),
        (*_RUNS, "tests/instrument/files/test_atomic.py", "tests/instrument/files/test_record.py"),
    ),
    "drops": (("drivers/common/drops.py",), ("tests/drivers/test_drops.py",)),
    "streams": (
        (
            "drivers/common/stream.py",
            "drivers/common/stream_reader.py",
            "drivers/common/buffered_camera.py",
            "recon/streams/video.py",
            "recon/streams/fit.py",
            "recon/streams/live.py",
            "recon/streams/live_picture.py",
            "recon/streams/pace.py",
            "recon/streams/joint.py",
            "recon/streams/stillness.py",
            "instrument/live/live.py",
        ),
        (
            "tests/drivers/test_stream.py",
            "tests/drivers/test_answers.py",
            "tests/drivers/test_aravis.py",
            "tests/drivers/test_basler.py",
            "tests/drivers/test_micromanager.py",
            "tests/drivers/test_simulated_contracts.py",
            "tests/recon/video",
            "tests/recon/live",
            "tests/instrument/live",
        ),
    ),
    "units": (
        (
            "drivers/common/stage_axes.py",
            "drivers/common/port_stage.py",
            "drivers/common/pixels.py",
            "drivers/common/unpacking.py",
            "drivers/common/camera_settings.py",
            "drivers/apt/drives.py",
            "drivers/grbl/settings.py",
            "drivers/zaber/stage.py",
            "drivers/smc100/stage.py",
            "drivers/elliptec/stage.py",
            "recon/base/noise.py",
        ),
        (
            "tests/drivers/test_stage_axes.py",
            "tests/drivers/test_port_stages.py",
            "tests/drivers/test_pixels.py",
            "tests/drivers/test_simulated_contracts.py",
            "tests/drivers/test_apt.py",
            "tests/drivers/test_grbl.py",
            "tests/drivers/test_grbl_protocol.py",
            "tests/drivers/test_zaber.py",
            "tests/recon/test_bayer_and_noise.py",
        ),
    ),
    "solvers": (
        (
            "recon/solvers/admm.py",
            "recon/solvers/base.py",
            "recon/solvers/cosine_preconditioner.py",
            "recon/solvers/douglas_rachford.py",
            "recon/solvers/fista.py",
            "recon/solvers/operator_admm.py",
            "recon/solvers/prior_splits.py",
            "recon/solvers/sensor_admm.py",
            "recon/solvers/splitting.py",
            "recon/solvers/tv_admm_volume.py",
            "recon/solvers/volume_admm.py",
            "recon/solvers/wiener.py",
            "recon/priors/base.py",
            "recon/priors/total_variation.py",
        ),
        ("tests/recon/solvers", "tests/recon/priors", "tests/golden/test_golden.py"),
    ),
    "operators": (
        (
            "recon/camera/base.py",
            "recon/camera/convolution.py",
            "recon/camera/factors.py",
            "recon/camera/grid.py",
            "recon/camera/points.py",
            "recon/camera/spatially_varying.py",
            "recon/camera/transformed.py",
            "recon/camera/two_part.py",
            "recon/camera/varying_psfs.py",
        ),
        ("tests/recon/camera", "tests/golden/test_golden.py"),
    ),
}
"""Of each area its modules, and its tests; a test may notice a change in any area."""

"""No output of any command replaces an input: walked over all that commands declare."""

from __future__ import annotations

import ast
import inspect
import os
import typing
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import typer

from instrument.bench.config_file import load_config, template
from instrument.cli import COMMANDS, main
from instrument.cli.options import _WORDS, flat
from instrument.files.atomic import refuse_input, whole_file, write_bytes
from instrument.files.errors import FileError
from instrument.files.images import write_image
from instrument.plan import Part, Plan
from instrument.plan.model import load_plan
from instrument.reconstruction.checkpointing import CheckpointFolder
from instrument.tasks.task import WRITTEN, guarded, part_of
from instrument.tasks.task import _paths as paths_in
from recon.base.declare import Option

ROOT = Path(__file__).resolve().parents[2]
READ = {
    *(
        "again",
        "alignment",
        "bench",
        "calibration",
        "case",
        "dark",
        "file",
        "files",
        "film",
        "folder",
        "folders",
    ),
    *(
        "image",
        "new",
        "old",
        "pairs",
        "patterned",
        "psf",
        "response",
        "run",
        "runs",
        "slm_calibration",
        "erasures",
    ),
    *("target", "video", "volume", "weights", "what", "token_file", "scratch"),
}
"""Options that name what is read; ``token_file`` and ``scratch`` are made where there is nothing."""


def commands() -> Iterator[tuple[str, Callable[..., None]]]:
    """Give every command and sub-command with its function as it was before it took words."""

    def within(name: str, command: Any) -> Iterator[tuple[str, Callable[..., None]]]:
        for sub, one in getattr(command, "commands", {}).items():
            yield from within(f"{name} {sub}", one)
        if not getattr(command, "commands", {}):
            run = inspect.unwrap(command.callback)
            closed = inspect.getclosurevars(run).nonlocals
            yield name, closed.get("function", run)

    for name, command in COMMANDS.items():
        yield from within(name, typer.main.get_command(command.load()))


def stub(function: Callable[..., None], body: Callable[..., None]) -> Callable[..., None]:
    """Return ``body`` with what a command's function takes."""

    def done(**values: object) -> None:
        body(values)

    hints = typing.get_type_hints(function, include_extras=True)
    done.__signature__ = inspect.signature(function)  # type: ignore[attr-defined]
    done.__annotations__, done.__name__, done.__module__ = hints, function.__name__, function.__module__
    return done


def declared_by(run: Callable[..., None]) -> dict[str, Option]:
    """Return the declared options of a command's function as it is registered."""
    declared: dict[str, Option] = getattr(run, "declared")  # noqa: B009
    return declared


def files_of(function: Callable[..., None]) -> dict[str, tuple[str, Callable[[Path], object]]]:
    """Return a command's parameters that name files: the name, and what is typed for a path."""
    run = flat(stub(function, lambda _: None))
    found: dict[str, tuple[str, Callable[[Path], object]]] = {}
    for key, o in declared_by(run).items():
        if any(kind is Path for kind in (*o.kinds, o.item)):
            found[key] = (o.name, lambda path: [str(path)]) if o.item is Path else (o.name, str)
    for name, hint in typing.get_type_hints(function, include_extras=True).items():
        if name != "return" and part_of(hint) is None and Path in (kinds := _kinds(hint)):
            found[name] = (name, lambda path: [path]) if list in kinds else (name, lambda path: path)
    return found


def _kinds(hint: Any) -> set[Any]:
    return {hint, typing.get_origin(hint)}.union(*map(_kinds, typing.get_args(hint)))


COMMANDS_WITH_FILES = {name: function for name, function in commands() if files_of(function)}


def test_each_option_that_names_a_file_is_known_as_read_or_written() -> None:
    names = {name for function in COMMANDS_WITH_FILES.values() for name, _ in files_of(function).values()}
    assert {"out", "figure", "capture", "bench", "image", "runs"} < names
    assert not READ & set(WRITTEN)
    assert not names - READ - set(WRITTEN), "say in WRITTEN that it is written, or in READ that it is read"


@pytest.mark.parametrize("command", COMMANDS_WITH_FILES)
def test_no_command_writes_to_what_it_reads_however_that_is_called(
    tmp_path: Path, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("instrument.files.calibration_file.find_calibration", lambda folder: folder)
    function = COMMANDS_WITH_FILES[command]
    files = files_of(function)
    read, other = tmp_path / "read.tif", tmp_path / "other.tif"
    (tmp_path / "sub").mkdir()
    for path in (read, other):
        path.write_bytes(b"measured")
    (tmp_path / "link.tif").symlink_to(read)
    (tmp_path / "folder").symlink_to(tmp_path)
    os.link(read, tmp_path / "hard.tif")
    handle = os.open(read, os.O_RDONLY)
    names = [read, Path(os.path.relpath(read)), tmp_path / "sub/../read.tif", tmp_path / "link.tif"]
    names += [tmp_path / "folder/read.tif", tmp_path / "hard.tif", Path(f"/proc/self/fd/{handle}")]
    tried: list[Path] = []

    def body(values: dict[str, object]) -> None:
        for name, path in paths_in(values):
            if name in WRITTEN:
                tried.append(path)
                with whole_file(path) as temporary:
                    temporary.write_bytes(b"a result")

    run = flat(stub(function, body))
    usual = {key: typed(other) for key, (name, typed) in files.items() if name not in WRITTEN}
    numbers = {o.name: "2" if "max" in o.name else "0.5" for o in declared_by(run).values() if o.is_required}
    needed = {key: numbers.get(o.name) for key, o in declared_by(run).items()}
    if command == "plan illumination":
        needed["options__lattice"] = "2"  # one of three
    outputs = [(key, typed) for key, (name, typed) in files.items() if name in WRITTEN]
    new = {key: typed(tmp_path / "new.tif") for key, typed in outputs}
    try:
        for into, as_typed in outputs:
            for key, (_, typed) in ((key, files[key]) for key in usual):
                for path in names:
                    values = needed | usual | new | {key: typed(read), into: as_typed(path)}
                    with pytest.raises(FileError, match="no output replaces an input"):
                        run(SimpleNamespace(meta={_WORDS: set()}), **values)
    finally:
        os.close(handle)
    assert bool(tried) == bool(outputs and usual)
    assert read.read_bytes() == other.read_bytes() == b"measured"


def test_what_an_input_names_in_its_turn_is_an_input(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mask.png").write_bytes(b"a mask")
    (tmp_path / "bench.toml").write_text(
        f"{template('display')}".replace("[display]", '[display]\nmask_file = "mask.png"')
    )
    plan = Plan(label="p", parts=(Part(label="a", slm_images=(Path("mask.png"),)),))
    (tmp_path / "plan.json").write_text(plan.to_json())
    for read, files in (
        (load_config, ("bench.toml", "mask.png")),
        (lambda: load_plan(Path("plan.json")), ("plan.json", "mask.png")),
    ):
        with guarded({}):
            read()  # type: ignore[operator]
            for file in files:
                with pytest.raises(FileError, match="no output replaces an input"), whole_file(file):
                    pass
        with whole_file("mask.png") as temporary:  # in the window, between two pieces of work
            temporary.write_bytes(b"a mask")


def test_a_file_and_a_folder_are_known_by_the_disk_not_by_their_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Links that nothing resolves, as a disk has it that knows no case, or one that is mounted twice."""
    monkeypatch.setattr(Path, "resolve", lambda self, strict=False: self.absolute())
    psfs, run = tmp_path / "psfs", tmp_path / "run"
    psfs.mkdir()
    run.mkdir()
    for file in (psfs / "a.tif", psfs / "b.tif", run / "state.json", run / "log.jsonl"):
        file.write_bytes(b"measured")
    (tmp_path / "PSFS").symlink_to(psfs)
    (run / "LOG.jsonl").symlink_to(run / "log.jsonl")
    refused = pytest.raises(FileError, match="no output replaces")
    for read, output in (
        (psfs, "PSFS/a.tif"),
        (psfs / "a.tif", "PSFS/a.tif"),
        (psfs / "a.tif", "PSFS"),
        (psfs / "b.tif", "run/LOG.jsonl"),
        (Path(f"{psfs / 'a.tif'}::psf"), "psfs/a.tif"),
        (Path(f"{psfs / 'a.tif'}::psf"), "PSFS"),
    ):
        with refused, guarded({"psf": read, "out": tmp_path / output}):
            refuse_input(tmp_path / output)
    with guarded({"psf": psfs, "out": tmp_path / "PSFS" / "new.json"}):
        write_bytes(tmp_path / "PSFS" / "new.json", b"a result")


def test_no_result_becomes_one_more_image_of_a_folder_that_is_read(tmp_path: Path) -> None:
    """The next reading would take it, or its preview, for one of the PSFs."""
    stack, link = tmp_path / "stack", tmp_path / "link"
    stack.mkdir()
    link.symlink_to(stack)
    (stack / "a.tif").write_bytes(b"measured")
    for name in ("new.tif", "new.PNG", "new.ome.zarr"):
        for folder in (stack, link):
            with (
                pytest.raises(FileError, match=r"one more image of .*stack, an input"),
                guarded({"volume": stack, "out": folder / name}),
            ):
                pass
    for values in (
        {"volume": stack, "out": stack / "below" / "new.tif"},
        {"image": stack / "a.tif", "out": stack / "new.tif"},
        {"scratch": stack, "out": stack / "new.tif"},
    ):
        with guarded(values):
            pass


def test_nor_does_one_by_the_name_that_a_command_gives_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stack = tmp_path / "stack"
    stack.mkdir()
    for depth_mm in (100, 200):
        write_image(stack / f"z{depth_mm}mm.tif", np.eye(16, dtype=np.uint16))
    write_image(tmp_path / "photo.tif", np.eye(16, dtype=np.uint16))
    monkeypatch.chdir(stack)
    assert main(["reconstruct", "--volume", ".", "--image", "../photo.tif"]) == 2
    assert "one more image of" in capsys.readouterr().err
    assert len(list(stack.iterdir())) == 2


def test_a_checkpoint_that_an_input_was_put_into_is_not_removed_with_it(tmp_path: Path) -> None:
    folder = tmp_path / "kept"
    CheckpointFolder(folder, {"a": 1})
    (folder / "photo.tif").write_bytes(b"measured")
    with (
        pytest.raises(FileError, match="holds the input"),
        guarded({"image": folder / "photo.tif", "checkpoint": folder}),
    ):
        CheckpointFolder(folder, {"a": 1}).remove()
    assert (folder / "photo.tif").exists()


_WRITERS = {
    *(
        "write_text",
        "write_bytes",
        "imwrite",
        "savez",
        "savefig",
        "open_memmap",
        "tofile",
        "rmtree",
        "unlink",
    ),
    *("TiffWriter", "VideoWriter", "open_group", "copyfile", "copytree", "O_WRONLY", "O_RDWR"),
}
_WHOLE = {"whole_file", "whole_folder", "draft_folder"}
_GIVEN_A_DRAFT = """
activity: write_activity_figure|atomic: clear_left|atomic: draft_folder|atomic: whole_file
calibration_file: _write|calibration_file: _write_ome_zarr|export: _npy|export: _tiff|images: _write_png
images: _write_tiff|ome_tiff: write_ome_tiff|opening: _open_zarr|result: figure_png"""
_IN_A_FOLDER_OF_ITS_OWN = """
checkpointing: CheckpointFolder.remove|display: run_display_demo|frame_array: FrameArray._write_draft
frame_array: FrameArray.remove_draft|frame_array: FrameArray.remove_half_written|frame_array: FrameArray.write
log: AppendOnlyLog.__init__|run_files: note_damage|screen_bench: _written
stability_file: CellLog.add|video_files: VideoPictures.__init__|video_files: VideoPictures.remove
video_files: VideoPictures.remove_litter|video_job: VideoJob.go_on_without|video_job: VideoJob.mark_done
video_job: VideoJob.remove|writer: lock_run|serve: _token|video_files: VideoPictures.say_white
purpose: Purpose.analysed|plan_procedures: ResumeProcedure.perform"""
_REFUSED_BEFORE = """
film: _write_zarr|result_file: _take_away_others|video: _job"""
_NOWHERE = "__init__: main"  # the null device


def writes(tree: ast.AST, within: str = "", whole: bool = False) -> Iterator[str]:
    """Give the functions that write to a file outside of a block that gives them a draft's name."""
    for node in ast.iter_child_nodes(tree):
        inside, place = whole, within
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            place = f"{within}.{node.name}" if within else node.name
        if isinstance(node, ast.With):
            inside = whole or any(word in _WHOLE for item in node.items for word in words_of(item))
        name = node.attr if isinstance(node, ast.Attribute) else ""
        opened = isinstance(node, ast.Call) and "open" in (
            getattr(node.func, "attr", ""),
            getattr(node.func, "id", ""),
        )
        is_open = opened and any(
            isinstance(a, ast.Constant) and isinstance(a.value, str) and bool(set(a.value) & set("wax+"))
            for a in (*node.args, *(k.value for k in node.keywords if k.arg == "mode"))
        )
        is_save = name == "save" and isinstance(node, ast.Attribute) and words_of(node.value) & {"np"}
        if not inside and (name in _WRITERS or is_open or is_save):
            yield place
        yield from writes(node, place, inside)


def words_of(node: ast.AST) -> set[str]:
    return {
        n.attr if isinstance(n, ast.Attribute) else n.id
        for n in ast.walk(node)
        if isinstance(n, ast.Attribute | ast.Name)
    }


def test_everything_is_written_through_what_refuses_inputs() -> None:
    found = {
        f"{path.stem}: {place}"
        for folder in ("instrument", "calibration_routines", "gui")
        for path in (ROOT / folder).rglob("*.py")
        if any(word in (text := path.read_text("utf-8")) for word in (*_WRITERS, "open(", "save("))
        for place in writes(ast.parse(text))
    }
    known = "|".join((_GIVEN_A_DRAFT, _IN_A_FOLDER_OF_ITS_OWN, _REFUSED_BEFORE, _NOWHERE)).replace("\n", "|")
    assert found == set(known.split("|")) - {""}

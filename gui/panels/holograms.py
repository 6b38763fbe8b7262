"""Holograms: target and what counts in it, computing, showing on the SLM, what the camera saw."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from PySide6.QtWidgets import QStackedWidget, QVBoxLayout, QWidget

from calibration_routines.display.hologram_photograph import Photographed
from gui.background import NewestOnly
from gui.forms.fields import Behaviour, ChoiceField
from gui.forms.options_form import OptionsForm, SuggestedName
from gui.hologram_work import (
    Computed,
    HologramOrder,
    Progress,
    compute,
    compute_lines,
    explain,
    photograph,
    show_on_slm,
)
from gui.jobs import Job, JobContext
from gui.panel import Panel
from gui.panels.unserved import why_not
from gui.session import BenchSession
from gui.widgets.building import Hint, button, fill, in_column, in_row, label, scrolled, share_bar, split
from gui.widgets.dialogues import choose_path
from gui.widgets.hologram_views import WEIGHTS_SHAPE, HologramViews, WeightsMode
from instrument.bench.config_file import TEMPLATES
from instrument.display.bench_display import depth_limit_mm, expansion_side
from instrument.display.hologram import field_picture, field_words, square
from instrument.files.errors import BenchError
from instrument.files.images import read_image
from instrument.reconstruction.forecast import Forecast
from recon.arrays import Array
from recon.base.as_python import expression
from recon.base.declare import option, options_of
from recon.errors import InputError
from recon.holography import LOSSES, HologramOptions
from recon.holography.display import require_defocus

_IMAGES = "Pictures (*.png *.tif *.tiff *.jpg *.bmp *.npy)"
_PREVIEW_ITERATIONS = 8
_AVERAGE = 4
_MODES: dict[str, WeightsMode] = {"all alike": "uniform", "a fovea, dragged": "fovea", "painted": "painted"}
_BY_MOUSE = ("centre", "radius")
"""Options of the fovea, which is dragged."""


@dataclass(frozen=True, kw_only=True)
class _PanelOptions:
    """What only the panel asks for: what is drawn on the target, and how the pattern is shown."""

    counts: str = option(
        "all alike", help="Which part of the picture counts.", choices=tuple(_MODES), group="What counts"
    )
    brush: float = option(
        0.06, help="Radius of the brush, as a fraction of the field.", above=0, most=1, group="What counts"
    )
    correction: Path | None = option(
        None,
        help="The SLM's look-up table and flatness, by the SLM calibration in Sweeps.",
        default_words="an ideal SLM",
        label="SLM's table",
        group="Display",
    )


class HologramsPanel(Panel):
    """A hologram of one picture, from the target to its photograph."""

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(session, parent)
        self.computed: Computed | None = None
        self.job: Job | None = None
        self._reader = NewestOnly(session.jobs, "Reading the picture")
        self._target_shown: object = None
        """Which picture is shown, when it was changed last, and how it fills the field."""

    def parts(self) -> Iterator[None]:
        """Make the widgets."""
        session = self.session
        across = split(left := QWidget())
        fill(self.body, across)
        self.form = self._make_form()
        place = scrolled(self.form)
        fill(left, (place, 1), margins=(0, 0, 6, 0))
        yield
        yield from self.form.parts()
        self._names = SuggestedName(self.jobs, self.form, session.runs_folder / "holograms", ".png")
        self.views = HologramViews()
        yield from self.views.parts()
        yield
        self.empty, self.shown = self._hint(), QStackedWidget()
        self.shown.addWidget(self.empty)
        self.shown.addWidget(self.views)
        across.addWidget(self.shown)
        across.setStretchFactor(1, 1)
        yield
        self.target = self.views.target
        tip = "Take off all that was painted (left button paints, right button rubs out)"
        self.clear = button("Clear what was painted", tip, self.target.clear_strokes)
        tip = f"{_PREVIEW_ITERATIONS} iterations, nothing is written"
        self.preview_button = button("Preview", tip, lambda: self.compute(preview=True))
        self.compute_button = button(
            "Compute",
            "Compute and write the pattern (Ctrl+Return)",
            lambda: self.compute(),
            shortcut="Ctrl+Return",
            primary=True,
        )
        tip = "Say what time and memory it takes, by its first iterations; nothing is written"
        self.explain_button = button("Explain", tip, self.explain)
        tip = "End after the iteration in progress; what there is then is kept"
        self.stop_button = button("Stop and keep", tip, self.stop)
        tip = "Put the pattern on the SLM, its look-up table and flatness applied"
        self.show_button = button("Show on SLM", tip, self.show_on_slm)
        tip = "Show it, register the camera by the mask's speckle, photograph, compare with the target"
        self.capture_button = button("Show and photograph", tip, self.photograph)
        self.progress = share_bar()
        self.note = label(role="dim", wraps=True)
        self.note.hide()
        yield
        below = in_column(
            self.clear,
            self.views.plane,
            self.note,
            self.progress,
            in_row(self.preview_button, self.compute_button, self.explain_button, self.stop_button),
            in_row(self.show_button, self.capture_button),
        )
        column = left.layout()
        assert isinstance(column, QVBoxLayout)
        column.addLayout(below)
        across.setSizes([330, 850])
        yield
        self.form.refused.connect(self.refused)
        self.form.settled.connect(self._settled)
        self._show_mode()
        self._set_running(False)

    def _hint(self) -> Hint:
        """Return what stands in the views' place until a picture is there."""
        if why := why_not(self.session, "Computing a hologram", ("slm",), ""):
            tried_on = f"Open the simulated {TEMPLATES['display'][0]}"
            return Hint(why, tried_on, lambda: self.session.handed_on.emit("start", "display"))
        words = "No hologram yet: choose the picture that the display is to show, then preview or compute it."
        return Hint(words, "Choose a picture…", self._choose_picture)

    def _choose_picture(self) -> None:
        def chosen(path: Path) -> None:
            self.form.set_values({"picture": path})

        choose_path(self, "open", "Choose a picture", "", chosen, _IMAGES)

    @property
    def options_form(self) -> OptionsForm:
        """The form whose fields messages are about."""
        return self.form

    def _make_form(self) -> OptionsForm:
        own, order = ({o.name: o for o in options_of(cls)} for cls in (_PanelOptions, HologramOrder))
        how = {o.name: o for o in options_of(HologramOptions) if o.name not in _BY_MOUSE}
        bench = f"{self.session.config.display.expansion}: the bench's"
        expansion = how["expansion"]
        said = replace(expansion.declaration, default_words=bench)
        how["expansion"] = replace(expansion, declaration=said)
        return OptionsForm(
            [
                *(order[name] for name in ("picture", "z_mm", "further")),
                *(own[name] for name in ("counts", "brush")),
                *how.values(),
                order["alignment"],
                own["correction"],
                order["out"],
            ],
            {
                "picture": Behaviour(filters=_IMAGES, must_exist=True),
                "z_mm": Behaviour(require=self._beyond_reach),
                "further": Behaviour(require=lambda planes: self._beyond_reach(*(z for _, z in planes))),
                "expansion": Behaviour(require=_no_square),
                "loss": Behaviour(help_of=lambda name: LOSSES[name].help),
                "alignment": Behaviour(filters="Alignments (*.json)", must_exist=True),
                "correction": Behaviour(filters="SLM calibrations (*.json)", must_exist=True),
                "out": Behaviour(browse="save", filters="Patterns (*.png)"),
            },
            whole=False,
        )

    def wholes(self) -> list[QWidget]:
        """Return the form's halves: it has many of the panel's widgets."""
        return self.form.wholes()

    # What is asked for ---------------------------------------------------------------------------
    def order(self, *, preview: bool = False) -> HologramOrder:
        """Return what the form asks for.

        Raises BenchError, InputError when a field is not understood, or nothing counts.
        """
        options = replace(self.form.make(HologramOptions), weights=self.target.weights())
        if preview:
            options = replace(options, iterations=_PREVIEW_ITERATIONS)
        return replace(self.form.make(HologramOrder), options=options)

    def _settled(self, name: str) -> None:
        """Take over what an option of the target is now."""
        self.note.hide()
        if name in ("picture", "fit", "srgb"):
            self._picture_changed()
        elif name in ("expansion", "distance_mm"):  # they set how far the depths reach
            self.form.recheck("z_mm", "further")
        elif name == "counts":
            self._show_mode()
        elif name == "periphery":
            self.target.set_periphery(self.form.value("periphery"))
        elif name == "brush":
            self.target.set_brush_radius(self.form.value("brush"))

    def _beyond_reach(self, *depths_mm: float) -> str:
        """Say why the display cannot show a depth; without its SLM that is not known."""
        slm = self.session.bench.slm
        if slm is None or not self.session.is_open("slm"):
            return ""
        try:
            q = self.form.value("expansion")
            if self.form.value("distance_mm") is not None:
                return ""  # said when it is computed
        except BenchError:
            return ""  # refused at its own field
        limit_mm = depth_limit_mm(self.session.config, (slm.shape, slm.pixel_pitch_um), expansion=q)
        try:
            for z_mm in depths_mm:
                require_defocus(z_mm, limit_mm)
        except InputError as error:
            return str(error)
        return ""

    def as_python(self) -> str:
        """Return lines that compute and write this hologram."""
        try:
            return compute_lines(self.order(), self.session.config, self._weights_expression())
        except (BenchError, InputError) as error:
            return f"# The form is not complete: {' '.join(str(error).split())}\n"

    def _weights_expression(self) -> str | None:
        view = self.target
        if view.mode == "uniform":
            return None
        if view.mode == "fovea":
            return (
                f"foveal_weights({WEIGHTS_SHAPE}, centre={view.centre}, radius={view.radius}, "
                f"periphery={view.periphery})"
            )
        return f"painted_weights({WEIGHTS_SHAPE}, {expression(view.strokes)}, background={view.periphery})"

    # Doing it ------------------------------------------------------------------------------------
    def compute(self, *, preview: bool = False) -> Job | None:
        """Compute the hologram; a preview takes few iterations and writes nothing."""
        asked = self._order_and_size(preview=preview)
        if asked is None:
            return None
        order, size = asked
        config = self.session.config
        title = "Previewing a hologram" if preview else f"Computing {order.out.name}"

        def work(context: JobContext) -> Computed:
            if not preview:
                self._names.make_room(order.out)
            return compute(order, config, size, context, write=not preview)

        job = self._started(self.follow(self.jobs.compute(title, work)))
        self.shown.setCurrentWidget(self.views)
        self.views.begin()
        for early in (job.failed, job.cancelled):
            early.connect(lambda _: self.views.go_back())
        job.progressed.connect(self._progressed)
        job.succeeded.connect(self._computed)
        return job

    def explain(self) -> Job | None:
        """Say what time and memory the hologram takes, by its first iterations."""
        asked = self._order_and_size()
        if asked is None:
            return None
        (order, size), config = asked, self.session.config
        title = f"Explaining {order.out.name}"
        job = self._started(
            self.follow(self.jobs.compute(title, lambda context: explain(order, config, size, context)))
        )
        job.progressed.connect(lambda share: self.progress.setValue(round(1000 * share)))
        job.succeeded.connect(self._explained)
        return job

    def _explained(self, takes: Forecast) -> None:
        self.note.setText(f"Will take {takes}.")
        self.note.show()

    def _order_and_size(
        self, *, preview: bool = False
    ) -> tuple[HologramOrder, tuple[tuple[int, int], float]] | None:
        """Return what the form asks for, and the SLM's pixels; None, and why, where it cannot be."""
        if not self.form.check():
            return None
        slm = self.session.bench.slm
        if slm is None or not self.session.is_open("slm"):
            self.refused(None, "The bench's SLM is not open: it is not known what to compute a hologram for.")
            return None
        order = self.asked(lambda: self.order(preview=preview))
        return None if order is None else (order, (slm.shape, slm.pixel_pitch_um))

    def stop(self) -> None:
        """End the computation, or the frames that follow each other on the SLM."""
        if self.job is not None:
            self.job.cancel()

    def show_on_slm(self) -> Job | None:
        """Put the computed pattern on the SLM."""
        computed = self.computed
        if computed is None or not self.form.recheck("correction"):
            return None
        correction, bench = self.form.value("correction"), self.session.bench
        return self._device_job(
            lambda: self.jobs.device(
                f"Showing {computed.order.out.stem}",
                lambda context: show_on_slm(bench, computed, correction, context),
                {"slm"},
                endless=len(computed.result.hologram.slm) > 1,
            )
        )

    def photograph(self) -> Job | None:
        """Show the pattern, photograph it, and say how close it is to the target."""
        computed = self.computed
        if computed is None or not self.form.recheck("correction"):
            return None
        correction, bench = self.form.value("correction"), self.session.bench

        def work(context: JobContext) -> tuple[Photographed, Path]:
            self._names.make_room(computed.order.out)
            return photograph(bench, computed, correction, _AVERAGE, context)

        title = f"Photographing {computed.order.out.stem}"
        job = self._device_job(lambda: self.session.exclusive_job(title, work))
        if job is not None:
            job.succeeded.connect(self._photographed)
        return job

    def _device_job(self, start: Callable[[], Job]) -> Job | None:
        job = self.begin(start)
        return None if job is None else self._started(job)

    def _started(self, job: Job) -> Job:
        """Show that a job runs which the stop button ends."""
        self.job = job
        self.note.hide()  # of other options, it may be
        self._set_running(True)
        job.ended.connect(lambda: self._set_running(False))
        return job

    # Showing it ----------------------------------------------------------------------------------
    def _progressed(self, progress: Progress) -> None:
        self.progress.setValue(round(1000 * progress.share))
        self.views.show_progress(progress)

    def _computed(self, computed: Computed) -> None:
        self.computed = computed
        self.progress.setValue(1000)
        self.views.show_computed(computed)
        for path in computed.patterns:
            self.session.log("info", f"Wrote {path}")
        self._suggest_out()
        self._set_running(False)

    def _photographed(self, outcome: Any) -> None:
        photographed, path = outcome
        self.views.show_photographed(photographed, str(path))
        self.session.log("info", f"Wrote {path}")

    def _picture_changed(self) -> None:
        """Show the target as it fills the field."""
        try:
            path, fit, srgb = (self.form.value(name) for name in ("picture", "fit", "srgb"))
        except BenchError:
            return  # refused at its field
        self._suggest_out()

        def read() -> tuple[object, Array, str] | str | None:
            try:
                wanted = (path, path.stat().st_mtime_ns, fit, srgb)
                if wanted == self._target_shown:
                    return None
                pixels = read_image(path).pixels
                return wanted, square(field_picture(pixels, fit=fit, srgb=srgb)), field_words(pixels, fit)
            except (BenchError, InputError, OSError) as error:
                return str(error)

        self._reader.ask(read, self._target_read)

    def _target_read(self, read: tuple[object, Array, str] | str | None) -> None:
        if isinstance(read, str):
            self._target_shown = None
            self.form.refuse("picture", read)
            self.refused(None, read)
        elif read is not None:
            self._target_shown, target, cropped = read
            if cropped:
                self.session.log("info", cropped)
            self.target.show_target(target)
            self.shown.setCurrentWidget(self.views)

    def _suggest_out(self) -> None:
        self._names.suggest(Path(str(self.form.fields["picture"].raw())).stem or "slm")

    def _show_mode(self) -> None:
        """Show what goes with which part of the picture counts: losses, brush, weight elsewhere."""
        mode = _MODES[self.form.value("counts")]
        hidden = {"uniform": {"periphery", "brush"}, "fovea": {"brush"}, "painted": set[str]()}[mode]
        self.form.hide_fields(hidden)
        losses = self.form.fields["loss"]
        assert isinstance(losses, ChoiceField)
        losses.offer([loss.name for loss in LOSSES.values() if loss.takes_weights == (mode != "uniform")])
        self.clear.setVisible(mode == "painted")
        self.target.set_mode(mode)

    def _set_running(self, running: bool) -> None:
        for start in (self.preview_button, self.compute_button, self.explain_button):
            start.setEnabled(not running)
        for use in (self.show_button, self.capture_button):
            use.setEnabled(not running and self.computed is not None)
        self.stop_button.setEnabled(running)
        if not running:
            self.progress.setValue(0)

    def take(self, path: Path) -> None:
        """Put an alignment of the mask into the form."""
        self.form.set_values({"alignment": path})

    def shutdown(self) -> None:
        """End the computation."""
        super().shutdown()
        self.stop()


def _no_square(expansion: int) -> str:
    """Say why an étendue expansion cannot be."""
    try:
        expansion_side(expansion)
    except BenchError as error:
        return str(error)
    return ""

"""What ``bench.toml`` may say: one model a table, and the configuration that results.

Reading a file with all its mistakes is :mod:`instrument.bench.config_file`'s work.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from drivers.device import Device, DriverOptions, SharedPart
from recon.types import Geometry

Kind = Literal["camera", "stage", "led_array", "slm"]
Level = Annotated[int, Field(ge=0, le=255)]


class Table(BaseModel):
    """A table of ``bench.toml``; unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class BenchTable(Table):
    """The bench as a whole."""

    name: str = Field(
        "bench", min_length=1, description="What the bench is called in figures, logs and files."
    )
    data_folder: str = Field(
        "runs", min_length=1, description="Where run folders are written; relative to this file's folder."
    )


class CameraTable(Table):
    """Settings that every camera has; a key left out leaves the camera as its driver opens it."""

    exposure_ms: float | None = Field(None, gt=0, description="Exposure time, milliseconds.")
    gain: float | None = Field(None, gt=0, description="Electronic gain as a factor; 1.0 is the base gain.")
    black_level: float | None = Field(None, ge=0, description="Offset that the camera adds, counts.")
    binning: int | None = Field(None, ge=1, description="Sensor pixels summed along each axis.")
    roi: tuple[int, int, int, int] | None = Field(
        None,
        description="Region of interest in sensor pixels before binning: [top, left, height, width].",
    )
    pixel_format: str | None = Field(None, description='GenICam name of the pixel format, e.g. "Mono12".')
    trigger_line: str | None = Field(
        None, min_length=1, description="Input that a hardware trigger comes in on, by the camera's name."
    )
    trigger_edge: Literal["rising", "falling"] | None = Field(
        None, description="Edge of the pulse that starts an exposure."
    )
    trigger_mode: Literal["free_run", "software", "hardware"] | None = Field(
        None,
        description='What starts an exposure; "hardware" here is for pulses from outside the bench: '
        "sequences by the wire of [trigger] set it themselves.",
    )


class StageTable(Table):
    """Settings that every stage has."""

    play: dict[str, Annotated[float, Field(gt=0)]] = Field(
        default_factory=dict,
        description=(
            "Play of the axes' screws by name, as calibrate stage measures it: the source comes to every "
            "place from one side."
        ),
    )


class LedArrayTable(Table):
    """Settings that every LED array has."""


class SlmTable(Table):
    """Settings that every SLM has."""

    blank_when_safe: bool = Field(
        True, description="Whether the SLM is blanked with the light whenever the bench is made safe."
    )


class SourceTable(Table):
    """The point source that PSFs are measured with: it rides on the stage, lit by the LED array."""

    offset_um: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0),
        description=(
            "Where the source is when every stage axis reads zero: [x, y, z] in micrometres from the centre "
            "of the diffuser's aperture."
        ),
    )
    leds: tuple[Annotated[int, Field(ge=0)], ...] = Field(
        (0,), min_length=1, description="Indices of the LEDs that light the source."
    )
    rgb: tuple[Level, Level, Level] = Field(
        (255, 255, 255), description="Their levels [red, green, blue], each 0 to 255."
    )
    size_um: float | None = Field(
        None, gt=0, description="Diameter of the source (pinhole), micrometres; kept with calibrations."
    )


class SceneTable(Table):
    """How the scene is lit and darkened, for photographs and dark frames."""

    control: Literal["simulated", "operator"] = Field(
        "operator",
        description='"simulated": the simulated world does it; "operator": a person is asked to.',
    )


class GeometryTable(Table):
    """Known optics; what is left out is taken from the devices where they can tell."""

    pixel_pitch_um: float | None = Field(
        None, gt=0, description="Pitch of the sensor's pixels before binning, micrometres."
    )
    diffuser_distance_mm: float | None = Field(
        None, gt=0, description="From the diffuser's textured side to the sensor, millimetres."
    )
    aperture_mm: tuple[float, float] | None = Field(
        None, description="Aperture on the diffuser: [height, width] in millimetres."
    )
    wavelength_nm: float | None = Field(None, gt=0, description="Centre wavelength, nanometres.")

    def geometry(self) -> Geometry:
        """Return the same as the type that reconstructions use."""
        return Geometry(self.pixel_pitch_um, self.diffuser_distance_mm, self.aperture_mm, self.wavelength_nm)


class TriggerTable(Table):
    """A trigger wire from a device that plays sequences to the camera: frames timed by hardware."""

    sent_by: Literal["led_array", "slm"] | None = Field(
        None,
        description="The device whose trigger output is wired to the camera's input (trigger_line of "
        "[camera]); left out: there is no wire, and plans go step by step.",
    )
    output: int = Field(0, ge=0, description="Which of its outputs, counted from 0.")
    period_ms: float | None = Field(
        None,
        gt=0,
        description="From one pattern to the next; left out: as fast as exposure and read-out allow.",
    )


class DisplayTable(Table):
    """The holographic display: SLM, scattering mask and Fourier lens, as holograms are computed for them."""

    slm_binning: int = Field(2, ge=1, description="SLM pixels used as one, along each axis.")
    expansion: int = Field(
        16,
        ge=1,
        description="Étendue expansion: mask pixels in the area of one (binned) SLM pixel; a square. "
        "1: without a mask.",
    )
    mask_file: str | None = Field(
        None,
        min_length=1,
        description=(
            "Image of the mask, one image pixel a mask pixel, two values (the greater is pi); relative to "
            "this file's folder. Left out: a random mask."
        ),
    )
    mask_seed: int = Field(0, ge=0, description="Of the random mask.")
    mask_fill: float = Field(
        1.0, ge=0, le=1, description="Clear width of a mask pixel over the mask's pitch; 0 leaves it out."
    )
    wavelength_nm: float = Field(660.0, gt=0, description="Of the laser; the mask is made for it.")
    focal_mm: float = Field(75.0, gt=0, description="Focal length of the Fourier lens.")
    dc_power: float = Field(
        0.0, ge=0, lt=1, description="Share of the light that the SLM does not modulate and nothing blocks."
    )
    dc_phase_rad: float = Field(0.0, description="Its phase relative to grey level 0.")


DEVICE_TABLES: Mapping[Kind, type[Table]] = {
    "camera": CameraTable,
    "stage": StageTable,
    "led_array": LedArrayTable,
    "slm": SlmTable,
}
"""The kinds of devices, in the order in which they are opened, with the keys common to each kind."""

PLAIN_TABLES: Mapping[str, type[Table]] = {
    "bench": BenchTable,
    "source": SourceTable,
    "scene": SceneTable,
    "geometry": GeometryTable,
    "display": DisplayTable,
    "trigger": TriggerTable,
}


@dataclass(frozen=True, slots=True)
class DeviceConfig:
    """One device as configured: its driver, the driver's own options, the settings common to its kind."""

    kind: Kind
    driver_name: str
    driver: type[Device]
    options: DriverOptions
    settings: Table


@dataclass(frozen=True, slots=True)
class SharedConfig:
    """A part that several drivers share, with its options."""

    part: type[SharedPart]
    options: DriverOptions


@dataclass(frozen=True, slots=True)
class BenchConfig:
    """A checked ``bench.toml``."""

    path: Path | None
    """The file it was read from; None for the embedded default."""
    text: str
    """The TOML text as it was read, kept with every run."""
    bench: BenchTable
    source: SourceTable
    scene: SceneTable
    geometry: GeometryTable
    display: DisplayTable
    trigger: TriggerTable
    devices: Mapping[Kind, DeviceConfig]
    """Only devices that the bench has."""
    shared: Mapping[str, SharedConfig] = field(default_factory=dict)
    """By the name of their table."""

    @property
    def data_folder(self) -> Path:
        """Where run folders are written, absolute."""
        base = self.path.parent if self.path else Path()
        return (base / Path(self.bench.data_folder).expanduser()).resolve()

    @property
    def label(self) -> str:
        """The bench's name and where its configuration came from."""
        return f"{self.bench.name} ({self.path or 'built-in configuration'})"

    def as_dict(self) -> dict[str, Any]:
        """Return everything as used, defaults included, JSON-compatible: the provenance of a run."""
        tables: dict[str, Any] = {name: getattr(self, name).model_dump(mode="json") for name in PLAIN_TABLES}
        for kind, device in self.devices.items():
            tables[kind] = {
                "driver": device.driver_name,
                **device.settings.model_dump(mode="json"),
                **device.options.model_dump(mode="json"),
            }
        for name, shared in self.shared.items():
            tables[name] = shared.options.model_dump(mode="json")
        return tables

"""Light and stillness against literal words of what they are, frame by frame."""

from __future__ import annotations

import numpy as np
import pytest

from recon.streams.stillness import SceneState, SceneWatch, has_light


def means(image: np.ndarray, side: int) -> np.ndarray:
    """Means of whole blocks, one after the other."""
    height, width = (n // side for n in image.shape)
    return np.array(
        [
            [image[side * y : side * (y + 1), side * x : side * (x + 1)].mean() for x in range(width)]
            for y in range(height)
        ]
    )


def spread(image: np.ndarray) -> float:
    """How far beyond its bound the variance of block means is, for pixels of unit noise."""
    found = []
    for side in (8, 16, 32):
        if min(image.shape) >= 2 * side:
            blocks = means(image, side)
            found.append(blocks.var() * side**2 / max(2.0, 1 + 5 * np.sqrt(2 / blocks.size)))
    return max(found)


@pytest.mark.parametrize("shape", [(16, 16), (17, 40), (70, 31), (66, 64), (100, 130)])
@pytest.mark.parametrize("channels", [1, 3])
def test_a_frame_has_light_where_block_means_vary_more_than_noise_lets_them(
    shape: tuple[int, int], channels: int
) -> None:
    frame = np.random.default_rng(1).normal(0, 2, (*shape, channels))
    if channels == 1:
        frame = frame[..., 0]
    each = frame if channels > 1 else frame[..., None]
    bounds = np.sqrt([spread(each[..., c]) for c in range(channels)])
    assert not has_light(frame, bounds * 1.001)
    if channels > 1:
        bounds[1:] *= 10  # the light of one colour is enough
    assert has_light(frame, bounds * 0.999)


def test_a_dimmer_frame_tells_its_noise_itself_and_a_small_one_tells_nothing() -> None:
    rng = np.random.default_rng(2)
    lit = rng.normal(0, 1, (64, 64)) + 3 * np.sin(np.arange(64) / 9)
    assert has_light(lit, np.array([50.0]))
    assert has_light(0.3 * lit, np.array([50.0]))
    assert not has_light(rng.normal(0, 1, (64, 64)), np.array([50.0]))
    assert not has_light(np.zeros((64, 64)), np.array([1.0]))
    assert not has_light(0.5 * np.eye(64), np.array([50.0]))  # most pixels are alike: no estimate
    assert has_light(np.zeros((15, 64)), np.array([1.0]))
    assert not has_light(np.zeros((16, 64)), np.array([1.0]))


class Literal:
    """What a watch is to say, without its short cuts."""

    def __init__(self, average: int) -> None:
        self.average, self.mean, self.count = average, np.empty(0), 0

    def see(self, frame: np.ndarray) -> str:
        frame = frame.astype(float)
        before, count = self.mean, self.count
        self.mean, self.count = frame, 1
        if count == 0 or before.shape != frame.shape:
            return "new"
        total = before.sum()
        gain = min(max(frame.sum() / total, 0.5), 2.0) if total > 0 else 1.0
        change = frame - gain * before
        variance = (change**2).mean()
        if not np.isfinite(variance):
            self.count = 1 if np.isfinite(frame).all() else 0
            return "new"
        if variance == 0 or self._white(change, variance):
            self.count = min(count + 1, self.average)
            self.mean = before + (frame - before) / self.count
            return "still"
        return "new" if variance > 0.5 * frame.var() else "moving"

    @staticmethod
    def _white(change: np.ndarray, variance: float) -> bool:
        for side in (2, 4, 8):
            if min(change.shape[1:]) // (side // 2) < 2:
                break
            blocks = np.array([means(channel, side) for channel in change])
            if side**2 * (blocks**2).mean() / variance > max(1.4, 1 + 5 * np.sqrt(2 / blocks.size)):
                return False
        return True


def scenes(shape: tuple[int, ...]) -> list[np.ndarray]:
    """Frames that stay, brighten, dim, move, change, break and go dark."""
    rng = np.random.default_rng(4)
    y, x = np.indices(shape[1:])

    def seen(at: float, light: float = 1.0, power: float = 40.0) -> np.ndarray:
        clean = 100 + power * np.sin((x + at) / 3.1) * np.cos(y / 4.2)
        return (light * (clean + rng.normal(0, 2, shape))).astype(np.float32)

    broken, still = seen(0), seen(0)
    broken[0, 0, 0] = np.nan
    frames = [seen(0), seen(0), seen(0), seen(0, 1.6), seen(0, 1.6), seen(0, 0.6), seen(0, 3.0), seen(0)]
    frames += [
        seen(0.4),
        seen(0.8),
        seen(9.7),
        seen(9.7),
        still,
        still,
        broken,
        seen(0),
        seen(0),
        -still,
        still,
    ]
    frames += [rng.normal(0, 2, shape).astype(np.float32) for _ in range(3)]
    frames += [seen(0)[:, :-1] for _ in range(2)]
    return [*frames, np.zeros(shape, np.float32), np.zeros(shape, np.float32)]


@pytest.mark.parametrize("shape", [(1, 40, 56), (3, 33, 24), (1, 7, 40), (1, 3, 5), (1, 2, 30)])
@pytest.mark.parametrize("average", [1, 3, 8])
def test_a_watch_says_and_keeps_what_it_should(shape: tuple[int, int, int], average: int) -> None:
    watch, literal = SceneWatch(average), Literal(average)
    for n, frame in enumerate(scenes(shape)):
        assert watch.see(frame) == literal.see(frame), n
        assert watch.count == literal.count, n
        assert watch.mean.dtype == np.float32
        np.testing.assert_allclose(watch.mean, literal.mean, rtol=1e-5, atol=1e-3, err_msg=str(n))
    watch.forget()
    assert watch.see(frame) is SceneState.NEW


def test_a_watch_keeps_a_frame_of_its_own_and_averages_at_least_one() -> None:
    frame = np.ones((1, 4, 4), np.float32)
    watch = SceneWatch()
    assert watch.average == 8
    watch.see(frame)
    frame[:] = 9
    assert (watch.mean == 1).all()
    assert SceneWatch(1).average == 1
    with pytest.raises(ValueError, match="average must be 1 or more, not 0"):
        SceneWatch(0)
    with pytest.raises(ValueError, match=r"a frame has pixels; this one is \(1, 0, 4\)"):
        watch.see(frame[:, :0])

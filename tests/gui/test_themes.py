"""Every theme can be read: contrasts of WCAG 2.1 AA; STOP stands out most."""

from __future__ import annotations

import pytest

from gui.theme import THEMES, contrast, luminance

TEXT, LARGE_OR_PART = 4.5, 3.0
"""Least contrasts of WCAG 2.1: 1.4.3 (text), 1.4.11 (borders and curves that say something)."""


@pytest.mark.parametrize("name", THEMES)
def test_contrasts_are_those_of_wcag_aa(name: str) -> None:
    theme = THEMES[name]
    grounds = (theme.window, theme.panel, theme.field)
    words = {n: getattr(theme, n) for n in ("text", "dim", "accent", "ok", "warning", "error")}
    low = [(n, g) for n, colour in words.items() for g in grounds if contrast(colour, g) < TEXT]
    low += [("border", g) for g in grounds if contrast(theme.border, g) < LARGE_OR_PART]
    low += [(c, theme.panel) for c in theme.curves if contrast(c, theme.panel) < LARGE_OR_PART]
    for ground, text in (
        (theme.stop, theme.stop_text),
        (theme.primary, theme.primary_text),
        (theme.badge, theme.badge_text),
        (theme.primary, theme.text),  # on a bar of progress
    ):
        low += [(text, ground)] if contrast(text, ground) < TEXT else []
    assert not low


@pytest.mark.parametrize("name", THEMES)
def test_stop_is_what_stands_out_most(name: str) -> None:
    theme = THEMES[name]
    others = (theme.panel, theme.field, theme.line, theme.primary, theme.badge)
    assert contrast(theme.stop, theme.window) > 2 * max(contrast(other, theme.window) for other in others)
    if name != "light":
        assert luminance(theme.stop) > max(map(luminance, others))


def test_contrast_is_that_of_the_standard() -> None:
    assert contrast("#000000", "#ffffff") == pytest.approx(21.0)
    assert contrast("#777777", "#ffffff") == pytest.approx(4.478, abs=1e-3)  # the standard's known near miss

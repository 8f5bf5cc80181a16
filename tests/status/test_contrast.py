"""The page's colours against WCAG 2.2: 4.5 for text, 3 for signs, controls and focus; light and dark."""

from __future__ import annotations

import re

import pytest

from services.status.page import STATIC

TEXT, SIGN = 4.5, 3.0
PAIRS = [
    *((text, ground, TEXT) for text in ("text", "text-soft") for ground in ("panel", "bg")),
    ("on-primary", "primary", TEXT),
    ("on-danger", "danger", TEXT),
    ("on-warn", "warn", TEXT),
    ("good", "panel", TEXT),
    ("bad-text", "panel", TEXT),
    ("control", "panel", SIGN),
    ("focus", "panel", SIGN),
    ("focus", "bg", SIGN),
    ("map-text", "map-halo", TEXT),
    *(
        (f"map-{sign}", "map-halo", SIGN)
        for sign in ("target", "new-path", "kept-path", "robot", "geofence", "no-go", "priority", "frontier")
    ),
    *((f"map-{line}", "map-ground", SIGN) for line in ("graph", "local", "policy", "trail", "old-path")),
    *((f"map-{line}", "map-covered", SIGN) for line in ("graph", "local", "policy", "trail", "old-path")),
    *((f"plot-{n}", "panel", SIGN) for n in range(1, 7)),
]


def palettes() -> dict[str, dict[str, str]]:
    css = (STATIC / "style.css").read_text(encoding="utf-8")
    light, dark = (block for block in re.findall(r":root \{(.*?)\}", css, re.DOTALL))
    first = dict(re.findall(r"--([a-z0-9-]+): (#[0-9a-f]{6});", light))
    return {"light": first, "dark": first | dict(re.findall(r"--([a-z0-9-]+): (#[0-9a-f]{6});", dark))}


def luminance(colour: str) -> float:
    """Relative luminance (WCAG 2.2)."""
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one: str, other: str) -> float:
    """Contrast ratio (WCAG 2.2), 1 to 21."""
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


def test_the_ratio_is_that_of_the_standard() -> None:
    assert contrast("#000000", "#ffffff") == pytest.approx(21.0)
    assert contrast("#777777", "#ffffff") == pytest.approx(4.48, abs=0.01)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_everything_that_is_read_is_readable(scheme: str) -> None:
    palette = palettes()[scheme]
    found = {(a, b): contrast(palette[a], palette[b]) for a, b, _ in PAIRS}
    weak = [f"{a} on {b}: {found[a, b]:.2f} < {least}" for a, b, least in PAIRS if found[a, b] < least]
    assert not weak


def test_every_colour_has_a_dark_one() -> None:
    light, dark = palettes()["light"], palettes()["dark"]
    assert not [name for name in light if light[name] == dark[name]]

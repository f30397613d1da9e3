"""The pages' style: who sees little, uses keys or paper, has a narrow screen or no scripts reads them too."""

import re

import pytest

from backend.report_page.diagrams import _BARS_WIDTH, _GRAPH_WIDTH, _MAP_WIDTH
from backend.report_page.template import TEMPLATES

CSS = (TEMPLATES / "page.css").read_text(encoding="utf-8")
PAGES = ("page.html.j2", "cameras.html.j2")
LIGHT, DARK = CSS.split("@media screen and (prefers-color-scheme: dark)")
DARK = DARK[: DARK.index("}\n}")]
ON_PAPER = CSS[CSS.index("@media print") :]


def colours(css: str) -> dict[str, str]:
    return dict(re.findall(r"--([a-z-]+): (#[0-9a-f]{6});", css))


def luminance(colour: str) -> float:
    """Relative luminance, https://www.w3.org/TR/WCAG22/#dfn-relative-luminance."""
    channels = [int(colour[start : start + 2], 16) / 255 for start in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return sum(weight * c for weight, c in zip((0.2126, 0.7152, 0.0722), linear, strict=True))


def contrast(one: str, other: str) -> float:
    """Contrast ratio, https://www.w3.org/TR/WCAG22/#dfn-contrast-ratio."""
    dark, light = sorted((luminance(one), luminance(other)))
    return (light + 0.05) / (dark + 0.05)


def test_black_on_white_is_the_most() -> None:
    assert contrast("#ffffff", "#000000") == pytest.approx(21.0)


@pytest.mark.parametrize("in_the_dark", [False, True])
@pytest.mark.parametrize("text", ["text", "soft", "accent"])
@pytest.mark.parametrize("ground", ["page", "card", "note"])
def test_words_stand_out_from_what_is_behind_them(text: str, ground: str, in_the_dark: bool) -> None:
    """Level AA of the WCAG for text of any size."""
    found = {**colours(LIGHT), **(colours(DARK) if in_the_dark else {})}
    assert contrast(found[text], found[ground]) >= 4.5


def test_paper_is_white_and_shows_the_bars() -> None:
    """The dark colours are the screen's alone, and browsers leave backgrounds out unless they are asked."""
    assert "print-color-adjust: exact" in ON_PAPER
    assert ".slider input" in ON_PAPER


def test_a_handle_that_cannot_be_dragged_is_not_there() -> None:
    assert "@media (scripting: none) { .slider input, .drag { display: none; } }" in CSS
    assert '<span class="drag">' in (TEMPLATES / "page.html.j2").read_text(encoding="utf-8")


def test_it_is_seen_where_the_keyboard_is() -> None:
    assert ":focus-visible" in CSS
    assert not re.search(r"outline: *(none|0)", CSS)


def test_long_paths_in_sentences_are_broken_on_narrow_screens() -> None:
    body = CSS[CSS.index("body {") :].partition("}")[0]
    assert "overflow-wrap: break-word" in body
    assert re.search(r"\.settings th, \.settings td \{ overflow-wrap: anywhere", CSS)


@pytest.mark.parametrize("page", PAGES)
def test_names_from_right_to_left_leave_what_is_beside_them_alone(page: str) -> None:
    """A name in Hebrew would draw the number after it to its other side."""
    text = (TEMPLATES / page).read_text(encoding="utf-8")
    names = re.findall(r"(.{5})\{\{ ([a-z_.\[\]]+\.(?:name|job_name)) \}\}(.{6})", text)
    assert len(names) >= 4
    for before, name, after in names:
        assert (before, after) == ("<bdi>", "</bdi>"), name


@pytest.mark.parametrize("page", PAGES)
def test_headers_of_tables_have_words(page: str) -> None:
    text = (TEMPLATES / page).read_text(encoding="utf-8")
    assert not re.search(r"<th[^>]*></th>", text)


def test_words_of_diagrams_can_be_read_on_a_phone() -> None:
    """At least 11 pixels high where diagrams are drawn smaller; what does not fit is scrolled within."""
    phone = CSS[CSS.index("@media (max-width: 640px)") : CSS.index("@media (scripting")]
    drawn_px, narrowest_px = (
        int(re.search(pattern, phone)[1])  # type: ignore[index]
        for pattern in (r"svg text \{ font-size: (\d+)px", r"\.diagram svg \{ min-width: (\d+)px")
    )
    assert drawn_px * narrowest_px / max(_GRAPH_WIDTH, _MAP_WIDTH, _BARS_WIDTH) >= 11
    assert ".diagram { overflow-x: auto; }" in phone

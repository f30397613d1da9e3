"""The report page in a real browser: no error, every picture shown, nothing wider than a phone."""

import html
import json
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from backend.scene import no_progress
from backend.stages.report import ReportConfig, build_report, render_report_html
from tests.report_scene import finished_run, with_truth

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine"),
]

PROBE = """
<script>
const problems = [];
addEventListener('error', event => problems.push(String(event.message)));
addEventListener('securitypolicyviolation', event => problems.push(event.violatedDirective));
addEventListener('load', () => {
  const slider = document.querySelector('input[type=range]');
  slider.value = 30;
  slider.dispatchEvent(new Event('input'));
  const found = {
    problems: problems,
    images: [...document.images].map(i => [i.naturalWidth, i.clientWidth, i.naturalHeight, i.clientHeight]),
    share: slider.parentNode.style.getPropertyValue('--share'),
    pageWidth: document.documentElement.scrollWidth,
    windowWidth: document.documentElement.clientWidth,
    title: document.title,
  };
  document.documentElement.setAttribute('data-found', JSON.stringify(found));
});
</script>
"""


@dataclass(frozen=True, kw_only=True)
class Opened:
    """What a browser made of a page."""

    problems: list[str]
    images: list[list[int]]
    share: str
    page_width: int
    window_width: int
    title: str
    console: list[str]


@pytest.fixture(scope="module")
def page() -> str:
    inputs = with_truth(finished_run(num_photos=3, width=240, resolution=3), resolution=3)
    return render_report_html(build_report(inputs, ReportConfig(picture_px=120), progress=no_progress))


@pytest.fixture
def browse(tmp_path: Path) -> Callable[[str, int], Opened]:
    def opened(page: str, width: int) -> Opened:
        (tmp_path / "report.html").write_text(page.replace("<head>", "<head>" + PROBE, 1), encoding="utf-8")
        run = subprocess.run(
            [
                str(CHROMIUM),
                "--headless",
                "--no-sandbox",
                "--disable-gpu",
                "--disable-background-networking",
                "--no-first-run",
                f"--user-data-dir={tmp_path / 'profile'}",
                "--enable-logging=stderr",
                f"--window-size={width},900",
                "--dump-dom",
                (tmp_path / "report.html").as_uri(),
            ],
            capture_output=True,
            text=True,
            timeout=120,
            check=True,
        )
        attribute = re.search(r'data-found="([^"]*)"', run.stdout)
        assert attribute, "the probe did not run"
        found = json.loads(html.unescape(attribute[1]))
        return Opened(
            problems=found["problems"],
            images=found["images"],
            share=found["share"],
            page_width=found["pageWidth"],
            window_width=found["windowWidth"],
            title=found["title"],
            console=[line for line in run.stderr.splitlines() if ":CONSOLE" in line],
        )

    return opened


@pytest.mark.parametrize("width", [1280, 500])
def test_the_page_opens_without_an_error_and_shows_its_pictures(
    page: str, browse: Callable[[str, int], Opened], width: int
) -> None:
    opened = browse(page, width)
    assert opened.problems == []
    assert opened.console == []
    assert opened.title == "Ball & ring <study> – FewView report"
    assert len(opened.images) == 3 * 4 + 2 + 4 + 4
    for natural_width, shown_width, natural_height, shown_height in opened.images:
        assert natural_width > 0
        assert shown_width > 60
        assert shown_height / shown_width == pytest.approx(natural_height / natural_width, abs=0.02)
    assert opened.share == "30%"
    assert opened.page_width <= opened.window_width


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("data:image/jpeg;base64,/9j/", "data:image/jpeg;base64,AAAA"),
        ('src="data:image/jpeg', 'src="file:///missing.jpg" data-was="'),
        ("oninput=", "oninput=nonsense() "),
        ("</style>", "</style><script>undefinedFunction()</script>"),
        ("</style>", "main { min-width: 1400px }</style>"),
    ],
)
def test_the_probe_finds_what_it_looks_for(
    page: str, browse: Callable[[str, int], Opened], old: str, new: str
) -> None:
    """A check of the check: each planted fault is seen in one of the things the test above asserts."""
    assert old in page
    opened = browse(page.replace(old, new, 1), 1280)
    assert (
        opened.problems
        or opened.console
        or min(image[0] for image in opened.images) == 0
        or opened.share != "30%"
        or opened.page_width > opened.window_width
    )

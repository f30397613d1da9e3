"""The page of the cameras in a real browser: no error, every diagram drawn, nothing wider than a phone."""

import html
import json
import re
import subprocess
from pathlib import Path
from typing import Any

import pytest

from backend.stages.cameras.camera_report import camera_report_html
from tests.end_to_end.test_report_in_browser import CHROMIUM
from tests.unit.test_camera_report import report_of, solved

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine"),
]

PROBE = """
<script>
const problems = [];
addEventListener('error', event => problems.push(String(event.message)), true);
addEventListener('securitypolicyviolation', event => problems.push(event.violatedDirective));
addEventListener('load', () => {
  const boxes = [...document.querySelectorAll('svg')].map(s => s.getBoundingClientRect());
  const texts = [...document.querySelectorAll('svg text')].map(t => getComputedStyle(t).fill);
  const found = {
    problems: problems,
    diagrams: boxes.map(box => [box.width, box.height]),
    textColours: [...new Set(texts)].length,
    pageWidth: document.documentElement.scrollWidth,
    windowWidth: document.documentElement.clientWidth,
    title: document.title,
  };
  document.documentElement.setAttribute('data-found', JSON.stringify(found));
});
</script>
"""


def opened(page: str, width: int, folder: Path) -> dict[str, Any]:
    """What a browser made of the page."""
    path = folder / "cameras.html"
    path.write_text(page.replace("<head>", "<head>" + PROBE, 1), encoding="utf-8")
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"]
    flags += ["--no-first-run", f"--user-data-dir={folder / 'profile'}", f"--window-size={width},900"]
    run = subprocess.run(
        [str(CHROMIUM), *flags, "--dump-dom", path.as_uri()],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    attribute = re.search(r'data-found="([^"]*)"', run.stdout)
    assert attribute, "the probe did not run"
    found: dict[str, Any] = json.loads(html.unescape(attribute[1]))
    return found


@pytest.mark.parametrize("width", [1280, 500])
def test_the_page_opens_without_an_error_and_draws_its_diagrams(width: int, tmp_path: Path) -> None:
    found = opened(camera_report_html(report_of(solved())), width, tmp_path)
    assert found["problems"] == []
    assert found["title"] == "Ball & ring – FewView cameras"
    assert len(found["diagrams"]) == 4
    for shown_width, shown_height in found["diagrams"]:
        assert shown_width > 250
        assert shown_height > 100
    assert found["textColours"] == 2, "the style sheet reaches into the diagrams"
    assert found["pageWidth"] <= found["windowWidth"]


def test_the_probe_sees_a_picture_that_can_not_be_shown(tmp_path: Path) -> None:
    page = camera_report_html(report_of(solved()))
    assert opened(page.replace('href="data:image/jpeg', 'href="file:///missing.jpg', 1), 1280, tmp_path)[
        "problems"
    ]

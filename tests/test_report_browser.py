"""The page of a diagnosis in a real browser: at the width of a desk and of a phone, in light and in dark."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import replace
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnosed_arm import JOINTS, diagnosed_arm
from PIL import Image

from equimus_ctrl.diagnosis.results import Named
from equimus_ctrl.report.diagnosis_page import page

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
DARK = "--blink-settings=preferredColorScheme=0"
PROBE = """<script>addEventListener("load", () => {
  const box = (node) => { const own = node.getBoundingClientRect(); return [own.width, own.left, own.right]; };
  const found = {
    scheme: matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light",
    width: document.documentElement.clientWidth, needed: document.documentElement.scrollWidth,
    images: [...document.images].map((one) => ({ drawn: one.naturalWidth, box: box(one), broad: one.className })),
    scrolls: [...document.querySelectorAll("figure, .wide")].map((one) => box(one)),
    folded: [...document.querySelectorAll("details")].map((one) => one.open),
    last: document.querySelector("section:last-of-type h2").textContent,
  };
  const told = document.createElement("pre"); told.id = "probe"; told.textContent = JSON.stringify(found);
  document.body.append(told);
});</script>"""
"""Measures the page as it is laid out; the page itself has no script."""


@pytest.fixture(scope="module")
def browser() -> str:
    found = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if found is None:
        pytest.skip(f"no browser is installed: none of {', '.join(BROWSERS)} is on the path")
    return found


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "report.html"
    arm = diagnosed_arm(spring=True)
    nothing = replace(arm.ranking[-1], named=Named("backlash", JOINTS[:1]), screened=0.1, fitted=None)
    arm = replace(arm, ranking=(*arm.ranking, nothing))
    path.write_text(page(arm, "Arm", "equimus-ctrl diagnose arm --write-model arm.toml"))
    return path


def ask(browser: str, profile: Path, *arguments: str) -> str:
    """What the browser prints, with a profile of its own."""
    common = ("--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", f"--user-data-dir={profile}")
    done = subprocess.run(
        [browser, *common, "--virtual-time-budget=4000", *arguments], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr[-500:]
    return done.stdout


def measured(browser: str, page_file: Path, width: int, dark: bool, folder: Path) -> dict[str, Any]:
    """A frame of that width is measured, since a browser's own window is never as narrow as a phone."""
    probed = folder / "probed.html"
    probed.write_text(page_file.read_text().replace("</body>", f"{PROBE}</body>"))
    frame = folder / "frame.html"
    frame.write_text(
        f'<body style="margin:0"><iframe src="probed.html" style="width:{width}px;height:900px;border:0"></iframe>'
        '<script>addEventListener("load", () => { document.body.append('
        'document.querySelector("iframe").contentDocument.getElementById("probe").cloneNode(true)); });</script>'
    )
    arguments = ["--allow-file-access-from-files", *([DARK] if dark else []), "--dump-dom", frame.as_uri()]
    found = re.search(r'<pre id="probe">(.*?)</pre>', ask(browser, folder / "profile", *arguments), re.S)
    assert found is not None
    return json.loads(unescape(found[1]))  # type: ignore[no-any-return]


@pytest.mark.slow
@pytest.mark.parametrize("width", [1280, 400])
@pytest.mark.parametrize("dark", [False, True])
def test_the_page_fits_a_desk_and_a_phone(browser: str, written: Path, width: int, dark: bool, tmp_path: Path) -> None:
    found = measured(browser, written, width, dark, tmp_path)
    assert found["scheme"] == ("dark" if dark else "light")
    assert found["width"] == width and found["needed"] <= width
    assert all(left >= 0 and right <= width for _, left, right in found["scrolls"])
    assert found["images"] and all(own["drawn"] > 0 for own in found["images"])
    for own in found["images"]:
        # Nothing is shrunk to less than half of what it was drawn for; what is broad scrolls within its figure.
        least = min(own["drawn"] / 2.1, 640 if own["broad"] else width - 40)
        assert own["box"][0] >= least, own
    assert found["folded"] and not any(found["folded"])
    assert found["last"] == "What to do next"


@pytest.mark.slow
def test_dark_pictures_keep_their_hues(browser: str, written: Path, tmp_path: Path) -> None:
    """Paper and ink change places; what is orange stays orange."""
    seen = {}
    for scheme, more in (("light", []), ("dark", [DARK])):
        shot = tmp_path / f"{scheme}.png"
        ask(browser, tmp_path / "profile", *more, "--window-size=1280,1400", f"--screenshot={shot}", written.as_uri())
        with Image.open(shot) as image:
            seen[scheme] = np.asarray(image.convert("HSV")).reshape(-1, 3).astype(int)
    paper = {scheme: np.median(pixels[:, 2]) for scheme, pixels in seen.items()}
    assert paper["light"] > 240 and paper["dark"] < 40
    orange = [(abs(p[:, 0] - 19) < 8) & (p[:, 1] > 130) & (p[:, 2] > 120) for p in seen.values()]
    assert all(own.mean() > 2e-4 for own in orange)

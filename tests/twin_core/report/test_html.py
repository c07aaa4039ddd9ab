"""The report page: complete, self-contained, safe, and content with nulls."""

import json
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from twin_core.report.html import render

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
EVIL = "</script><script>alert(1)</script><img src=x onerror=alert(1)>'\""


def example_report(name: str = "benchsat") -> dict[str, Any]:
    scores = {"rmse_K": 2.5, "pcc": 0.9, "per_sensor": {"T_px": {"rmse_K": 2.5, "pcc": 0.9, "bias_K": -1.5}}}
    after = {"rmse_K": 0.25, "pcc": 0.99, "per_sensor": {"T_px": {"rmse_K": 0.25, "pcc": 0.99, "bias_K": 0.01}}}
    finding = {
        "effect": "radiation_to_sink",
        "where": {"node": "px", "sink": "space"},
        "parameters": {"R_m2": {"mean": 0.113, "std": 0.002}},
        "evidence": {"log_bayes_factor": 21.3, "p_value": 2e-9},
        "alternatives": [
            {"effect": "leak_to_boundary", "where": {"node": "px", "boundary": "bus"}, "log_bayes_factor": 1.9}
        ],
    }
    return {
        "twin": name,
        "verdict": "effect_added",
        "train": {"start": "2026-01-01T00:00:00Z", "stop": "2026-01-02T00:00:00Z", "samples": 1440},
        "holdout": {"start": "2026-01-02T00:00:00Z", "stop": "2026-01-02T12:00:00Z", "samples": 720},
        "before": scores,
        "findings": [finding],
        "after": after,
        "noise_floor_K": 0.1,
        "residual_whiteness": {"before": 0.98, "after": 0.05},
        "elapsed_s": 12.0,
    }


def example_plots(name: str = "px") -> dict[str, Any]:
    time = list(np.arange(40.0))
    return {
        "dated": True,
        "time": time,
        "holdout_start": 30.0,
        "sensors": {"T_px": {"measured": [None, *time[1:]], "before": time, "after": time}},
        "missing_heat": [
            {"node": name, "time": time, "temperature_K": time, "mean_W": time, "std_W": time, "effect_W": None}
        ],
        "network": {"nodes": [name], "boundaries": [], "conductors": [], "radiators": [], "effects": []},
    }


class Page(HTMLParser):
    """Collects elements, visible text, and the address of everything that would be loaded."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.loaded: list[str] = []
        self.text = ""
        self.scripts = ""
        self._inside = ""
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self._inside = tag
        self.loaded += [value or "" for key, value in attrs if key in ("src", "href", "srcset", "data")]

    def handle_endtag(self, tag: str) -> None:
        self._inside = ""

    def handle_data(self, data: str) -> None:
        if self._inside == "script":
            self.scripts += data
        elif self._inside != "style":
            self.text += data


def data_of(page: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    data: dict[str, Any] = json.loads(found[1])
    return data


def test_the_numbers_stand_in_the_page() -> None:
    page = Page(render(example_report(), example_plots()))
    for text in ("Radiation to sink from px to space was missing", "2.50", "0.250", "10 times smaller", "21.3"):
        assert text in page.text
    assert "0.1130 ± 0.0020" in page.text
    assert "leak to boundary from px to bus" in page.text


@pytest.mark.parametrize("experiments", [None, [], [False], [True, False]])
def test_what_would_tell_a_finding_from_its_alternatives(experiments: list[bool] | None) -> None:
    """What decides is listed; where nothing does it is said; a report that does not know says neither."""
    report = example_report()
    if experiments is not None:
        report["findings"][0]["experiments"] = [
            {"experiment": f"warm it {k}", "sensor": "T_px", "apart_K": 0.51, "apart_std": 5.1, "decides": decides}
            for k, decides in enumerate(experiments)
        ]
    text = Page(render(report, example_plots())).text
    assert ("Nothing that was looked at would" in text) == (experiments is not None and not any(experiments))
    assert ("warm it 0: the models would part by 0.51 K at T_px, 5.1 times its noise" in text) == any(experiments or [])
    assert "warm it 1" not in text


def test_the_page_tells_why_a_finding_is_ambiguous() -> None:
    text = Page(render(example_report(), example_plots())).text  # 19.4 nats behind
    assert "too coarse to tell it from leak to boundary from px to bus: this explains nearly as much." in text
    assert "hardly tell" not in text


def test_nothing_is_loaded_from_elsewhere() -> None:
    page = render(example_report(), example_plots())
    assert Page(page).loaded == ["data:,"]
    styles = "".join(re.findall(r"<style>(.*?)</style>", page, re.DOTALL))
    assert "@import" not in styles and "url(" not in styles
    assert "MIT" in page or "uPlot" in Page(page).scripts


def test_every_text_is_escaped() -> None:
    plain = Page(render(example_report(), example_plots()))
    report = example_report(EVIL) | {"words": [EVIL], "notices": [EVIL]}
    report["findings"][0] |= {"effect": EVIL, "where": {"node": EVIL}, "equation": EVIL, "judged_with": [EVIL]}
    report["findings"][0]["alternatives"] = [
        {"effect": EVIL, "where": {"nodes": [EVIL, EVIL]}, "log_bayes_factor": 1.0}
    ]
    report["before"]["per_sensor"][EVIL] = {"rmse_K": 1.0}
    report["not_supported"] = [{"effects": [EVIL], "evidence": {}}]
    plots = example_plots(EVIL)
    plots["sensors"][EVIL] = plots["sensors"]["T_px"]
    page = Page(render(report, plots))
    assert page.tags.count("script") == plain.tags.count("script") == 3
    assert "img" not in page.tags
    assert page.text.count("onerror") >= 8


def test_data_survives_the_embedding() -> None:
    plots = example_plots()
    plots["sensors"] = {EVIL: plots["sensors"]["T_px"]}
    data = data_of(render(example_report(), plots))
    assert data["sensors"] == plots["sensors"]
    assert data["holdout_start"] == 30.0


def test_bins_of_missing_heat_follow_its_law() -> None:
    rng = np.random.default_rng(5)
    temperature_K = rng.uniform(250.0, 300.0, 4000)
    heat_W = 0.5 * (temperature_K - 270.0)
    item = {
        "node": "px",
        "time": np.arange(4000.0).tolist(),
        "temperature_K": temperature_K.tolist(),
        "mean_W": (heat_W + rng.normal(0.0, 1.0, 4000)).tolist(),
        "std_W": [1.5] * 4000,
        "effect_W": heat_W.tolist(),
    }
    heat = data_of(render(example_report(), {"missing_heat": [item]}))["missing_heat"][0]["by_temperature"]
    centre, mean, spread, effect = map(np.array, heat["bins"])
    law_W = 0.5 * (centre - 270.0)
    # 100 samples a bin: the mean of unit noise is good to 0.1, five of these in 40 bins are never exceeded.
    np.testing.assert_allclose(mean, law_W, atol=0.5)
    np.testing.assert_allclose(effect, law_W, atol=1e-3)
    np.testing.assert_allclose(spread, 1.5)
    assert (np.diff(heat["points"][0]) >= 0).all()


def test_no_findings_no_plots_no_optional_members() -> None:
    report = example_report() | {"findings": [], "verdict": "no_effect_supported"}
    for member in ("noise_floor_K", "residual_whiteness", "elapsed_s"):
        del report[member]
    page = Page(render(report, {}))
    assert "The declared model suffices" in page.text
    assert "svg" not in page.tags


@pytest.mark.parametrize("empty", [None, float("nan")])
def test_numbers_that_are_none(empty: float | None) -> None:
    report = example_report() | {"noise_floor_K": empty, "elapsed_s": empty, "verdict": "unexplained"}
    for part in ("before", "after"):
        report[part] = {"rmse_K": empty, "pcc": empty, "per_sensor": {"T": {"rmse_K": empty, "pcc": empty}}}
    report["findings"][0]["evidence"] = {"log_bayes_factor": empty, "p_value": empty}
    report["findings"][0]["parameters"] = {"R_m2": {"mean": empty, "std": empty}}
    report["residual_whiteness"] = {"before": empty, "after": empty}
    plots = example_plots()
    plots["holdout_start"] = empty
    plots["missing_heat"][0] |= {"mean_W": [empty] * 40, "std_W": [empty] * 40, "effect_W": [empty] * 40}
    plots["sensors"]["T_px"] = {"measured": [empty] * 40, "before": [empty] * 40, "after": [empty] * 40}
    page = Page(render(report, plots))
    assert "nan" not in page.text and "None" not in page.text


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_charts_are_drawn_in_a_browser(tmp_path: Path) -> None:
    plots = example_plots()
    plots["missing_heat"].append(plots["missing_heat"][0] | {"node": "mx", "mean_W": [None] * 40})
    (tmp_path / "page.html").write_text(render(example_report(), plots))
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-sync"]
    flags += ["--disable-component-update", "--no-first-run", "--virtual-time-budget=2000", "--enable-logging=stderr"]
    flags += [f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom", f"file://{tmp_path}/page.html"]
    run = subprocess.run([str(CHROMIUM), *flags], capture_output=True, text=True, timeout=120)
    assert "CONSOLE" not in run.stderr
    # One chart of the sensor, two of the first node; the second node has no heat to lay over its temperature.
    assert run.stdout.count("<canvas") == 4


@pytest.mark.browser
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_a_page_prints_as_pdf(tmp_path: Path) -> None:
    from replay.cli.main import main

    (tmp_path / "page.html").write_text(render(example_report(), example_plots()))
    assert main(["print", str(tmp_path / "page.html")]) == 0
    assert (tmp_path / "page.pdf").read_bytes().startswith(b"%PDF-")
    assert main(["print", str(tmp_path / "none.html"), "--out", str(tmp_path / "none.pdf")]) == 2

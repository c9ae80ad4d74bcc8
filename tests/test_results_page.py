"""The results page of the documentation: its tables are those of the committed CSV files."""

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest
from benchmark_results import final, write
from selenium import webdriver
from selenium.webdriver.common.by import By
from test_page import browser as browser

from sb3_have.benchmark.reading import DISTANCE, read_results
from sb3_have.evaluation.statistics import iqm, stratified_bootstrap

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def page() -> ModuleType:
    spec = importlib.util.spec_from_file_location("results", ROOT / "docs" / "_ext" / "results.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def cells(text: str) -> dict[str, list[str]]:
    """Rows by their first cell."""
    lines = [re.split(r" *\| *", line.strip("| ")) for line in text.splitlines() if line.startswith("| ")]
    return {line[0].strip("`"): line[1:] for line in lines}


def test_new_folder_appears_with_its_command(page: ModuleType, tmp_path: Path) -> None:
    runs = {"have": {5: (100.0, 200.0), 7: (300.0, 400.0)}, "sac": {5: (1000.0, 3000.0)}}
    write(tmp_path / "benchmarks" / "results" / "search" / "gamma", final=final(runs))
    write(tmp_path / "benchmarks" / "results" / "unfinished")
    (tmp_path / "benchmarks" / "grids" / "search").mkdir(parents=True)
    grid = tmp_path / "benchmarks" / "grids" / "search" / "gamma.yml"
    grid.write_text("methods: [have, sac]\nseeds: [5, 7]\n")
    text = page.results_markdown(tmp_path)
    assert re.findall("^## .*", text, re.M) == ["## search/gamma"]
    have = cells(text)["have"]
    # Mean of 200 and 300, the scores without the lowest and the highest; two seeds have no interval
    assert have[0] == "250" and have[3].split() == ["150", "(5),", "350", "(7)"]
    command = "python -m sb3_have.benchmark run benchmarks/grids/search/gamma.yml"
    assert have[-1] == f"`{command} --results benchmarks/results/search/gamma --only have`"
    assert cells(text)["sac"][0] == "2,000" and cells(text)["sac"][2] == "0.00"


def test_committed_results(page: ModuleType) -> None:
    rows = cells(page.results_markdown().split("## core\n")[1].split("\n## ")[0])
    scores = read_results([ROOT / "benchmarks" / "results" / "core"]).scores("have", DISTANCE)
    interval = [f"{value:,.0f}" for value in stratified_bootstrap(iqm, scores, whole_runs=True)]
    assert re.findall(r"[\d,]*\d", rows["have"][0]) == interval
    assert rows["have"][-1] == "`python -m sb3_have.benchmark run benchmarks/grids/core.yml --only have`"
    assert rows["IDM/MOBIL"][0] == "2,104"


TABLE = """<!doctype html><section id="results"><table><thead><tr><th>method</th><th>distance</th></tr></thead><tbody>
<tr><td>b</td><td>90 [80, 1,100]</td></tr><tr><td>none</td><td></td></tr><tr><td>a</td><td>1,100 [9, 9]</td></tr>
<tr><td>c</td><td>-3.5</td></tr></tbody></table></section>"""


def test_a_click_on_a_head_sorts(browser: webdriver.Chrome, tmp_path: Path) -> None:
    script = (ROOT / "docs" / "_static" / "sort_tables.js").read_text()
    (tmp_path / "page.html").write_text(f"{TABLE}<script>{script}</script>")
    browser.get((tmp_path / "page.html").as_uri())
    method, distance = browser.find_elements(By.CSS_SELECTOR, "th button")

    def order() -> list[str]:
        return [cell.text for cell in browser.find_elements(By.CSS_SELECTOR, "td:first-child")]

    orders = {distance: [["a", "b", "c", "none"], ["c", "b", "a", "none"]], method: [["a", "b", "c", "none"]]}
    for button, expected in orders.items():
        for names in expected:
            button.click()
            assert order() == names
    assert [head.get_attribute("aria-sort") for head in browser.find_elements(By.TAG_NAME, "th")] == ["ascending", None]

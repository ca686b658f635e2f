"""The page of a cohort: what is in it; how it sorts and filters, in a browser."""

import html
import json
import re

import numpy as np
import pytest
from browser import FRAMES, copied, document
from cohorts import HOSTILE, key_of, run_of, save_cohort, save_run, thumbnail

from tetopt.cohort import cohort_page as page
from tetopt.cohort.cohort_page import save_cohort_files
from tetopt.cohort.flags import flags_of
from tetopt.cohort.numbers import collect
from tetopt.io.text import plain


@pytest.fixture(scope="module")
def cohort(tmp_path_factory):
    """Its folder and its page, of 100 subjects."""
    out = tmp_path_factory.mktemp("cohort")
    save_cohort_files(out, collect(out, save_cohort(out, 100)))
    return out, page_of(out)


def page_of(out):
    return (out / "cohort.html").read_text(encoding="utf-8")


def data_of(text):
    return json.loads(
        re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)[1]
    )


def test_failures_are_on_top_with_their_logs(cohort):
    out, text = cohort
    names = {path.name for path in out.glob("cohort.*")}
    assert names == {"cohort.html", "cohort.json", "cohort.tsv"}
    assert "100 subjects: 94 done, 1 with a violated requirement, 4 failed, 1 not run." in text
    top, _, rest = re.split("<h2>Distributions</h2>|<h2>Subjects</h2>", text)
    assert "<h2>Failed: 4</h2>" in top
    # the colours of pictures are told above them
    words = "Orange is the mesh, blue the outline of the mask, other colours are labels."
    assert words in rest[: rest.index('<div id="subjects">')]
    reasons, links = zip(*re.findall(r"<tr><td>([^<]*)</td><td>(.*?)</td></tr>", top), strict=True)
    assert list(map(html.unescape, reasons)) == [
        "image.nii.gz: expected a NIfTI image, got a file that ends early",
        f"ended by SIGKILL {plain(HOSTILE)}",
    ]
    for names, ks in zip(links, ((2, 42), (22, 62)), strict=True):
        keys = re.findall(r'<a href="logs/([^"]*).log">([^<]*)</a>', names)
        assert keys == [(key_of(k), key_of(k)) for k in ks]


def test_what_differs_is_said_with_how_many(tmp_path):
    rng = np.random.default_rng(0)
    for k in range(10):
        run = run_of(rng)
        run["options"]["nodes"] = 250 if k < 2 else 300
        run["options"]["k_D"] = k / 10
        if k == 9:
            # the latter is options.k_D
            run["request"]["options"] |= {"gradation": HOSTILE, "k-d": "0.9"}
        save_run(tmp_path, key_of(k), run, thumbnail(k))
    save_cohort_files(tmp_path, collect(tmp_path))
    text = page_of(tmp_path)
    hostile = html.escape(plain(plain(HOSTILE)))
    words = f"nodes: 300 (8), 250 (2); k_D: 10 values; gradation: none (9), {hostile} (1)."
    assert f"Differences, with numbers of subjects: {words}" in text
    columns = {column["name"] for column in data_of(text)["columns"]}
    assert {"options.nodes", "options.k_D", "request.options.gradation"} <= columns
    assert "Common to all meshes: tetopt 0.1.0, method fast, young 3.0, format .vtu." in text
    assert re.search(r"Meshing took [\d.]+ min of computing time, ", text)


def test_names_do_no_harm(cohort):
    _, text = cohort
    assert HOSTILE not in text
    assert "<img src=x" not in text
    assert text.count("<script") == 2 == text.count("</script>")
    assert all(line.isprintable() for line in text.splitlines())
    assert "default-src 'none'" in text


def test_the_page_has_what_the_rows_have(cohort):
    out, text = cohort
    data, rows = data_of(text), collect(out, [key_of(82)])
    assert [row[0] for row in data["rows"]] == [row.key for row in rows]
    names = [column["name"] for column in data["columns"]]
    assert "labels.17.volume" in names
    for row, shown in zip(rows, data["rows"], strict=True):
        assert shown[5] == row.files.get("mesh", "")
        rho, own = shown[7 + names.index("quality.mean_rho")], row.numbers.get("quality.mean_rho")
        assert (rho is None) == (own is None)
        assert own is None or rho == pytest.approx(own, rel=1e-3)
    assert len(data["pictures"]) == sum("thumbnail" in row.files for row in rows) == 95


def test_of_many_subjects_the_odd_have_pictures(cohort, monkeypatch):
    out, _ = cohort
    rows = collect(out)
    monkeypatch.setattr(page, "PAGE_PICTURES", 20)
    save_cohort_files(out, rows)
    text = page_of(out)
    pictured = {int(place) for place in data_of(text)["pictures"]}
    assert len(pictured) == 20
    assert {place for place, own in enumerate(flags_of(rows)) if own} <= pictured
    assert "The page has 20 of them, flagged subjects first; the rest are linked." in text


def test_a_page_without_subjects_or_pictures(tmp_path):
    save_cohort_files(tmp_path, [])
    assert "0 subjects: none." in page_of(tmp_path)
    save_run(tmp_path, "sub-1", {"violated": {}})
    save_cohort_files(tmp_path, collect(tmp_path))
    assert "Orange is the mesh" not in page_of(tmp_path)


# What a reader does, one step after the other, and what is there then.
STEPS = """<script>
const say = (words) => {
  const options = {className: "said", textContent: words};
  document.body.append(Object.assign(document.createElement("p"), options)); };
const first = () =>
  [...document.querySelectorAll(".name b")].slice(0, 3).map((e) => e.textContent).join(" ");
const pick = (name, value) => { const e = document.querySelector(`[aria-label="${name}"]`);
  e.value = value; e.dispatchEvent(new Event(e.type === "search" ? "input" : "change")); };
const head = (words) =>
  [...document.querySelectorAll("th button")].find((e) => e.textContent.startsWith(words)).click();
const pager = () => document.querySelector(".pager").textContent;
const heights = [document.documentElement.scrollHeight];
say(first());
head("mean rho"); say(first()); head("mean rho"); say(first()); head("mean rho"); say(first());
head("subject"); say(first());
document.querySelectorAll(".pager button")[1].click(); say(first() + pager());
pick("Which subjects", "odd"); say(pager());
pick("Which subjects", "failed"); say(pager());
pick("Which subjects", "all"); pick("Filter by text", "LPS"); say(first());
pick("Filter by text", "");
document.querySelectorAll(".bar")[1].dispatchEvent(new Event("click")); say(first() + pager());
document.querySelector(".chips button").click(); say(pager());
pick("How", "pictures"); say(document.querySelectorAll(".tile img").length + " tiles");
document.querySelectorAll(".said").forEach((e) => e.hidden = true);
heights.push(document.documentElement.scrollHeight);
heights.forEach(say);
</script>"""


@pytest.mark.full
def test_a_browser_sorts_and_filters(cohort, tmp_path):
    out, text = cohort
    made = document(copied(text, tmp_path / "a.html", FRAMES, STEPS), "--window-size=1280,900")
    said = re.findall(r'<p class="said"[^>]*>([^<]*)</p>', made)
    rho = {row.key: row.numbers.get("quality.mean_rho") for row in collect(out)}
    rising = sorted(filter(rho.get, rho), key=lambda key: float(f"{rho[key]:.4g}"))
    n_odd = sum(map(bool, flags_of(collect(out)))) + 5
    assert said[0].startswith(key_of(43))  # a requirement violated
    assert [words.split()[0] for words in said[1:3]] == [rising[0], rising[-1]]
    page = " ".join(map(key_of, range(20, 23))) + "‹ before 21 to 40 of 100 next ›"
    assert said[3:6] == [said[0], " ".join(map(key_of, range(3))), page]
    assert f" of {n_odd} (100 in all)" in said[6]
    assert " of 4 (100 in all)" in said[7]
    assert said[8] == key_of(7)
    assert said[9].startswith(key_of(7) + "‹ before 1 to 1 of 1 (100 in all)")
    assert "of 100 " in said[10]
    assert said[11] == "45 tiles"
    assert len(said) == 14
    assert max(map(int, said[12:])) <= 5000  # pixels of height, of table and pictures


BARS = """<script>
const chart = [...document.querySelectorAll(".chart")]
  .find((e) => e.textContent.includes("volume of the mask"));
const bars = [...chart.querySelectorAll("title")].map((e) => e.textContent);
const feet = [...chart.querySelectorAll(".foot span")].map((e) => e.textContent);
for (const words of [bars[0], bars[bars.length - 1], ...feet])
  document.body.append(
    Object.assign(document.createElement("p"), {className: "said", textContent: words}));
</script>"""


@pytest.mark.full
def test_a_bar_says_what_lies_beyond_it(tmp_path):
    """The bars at the ends hold what is far out, and say so, with the numbers themselves."""
    rng = np.random.default_rng(0)
    volumes = [3.05e3, *np.linspace(1.0e6, 1.2e6, 18), 9.0e6]
    for k, volume in enumerate(volumes):
        save_run(tmp_path, key_of(k), run_of(rng, mask_volume=volume))
    save_cohort_files(tmp_path, collect(tmp_path))
    text = page_of(tmp_path)
    made = document(copied(text, tmp_path / "a.html", FRAMES, BARS))
    lowest, highest, left, right = re.findall(r'<p class="said">([^<]*)</p>', made)
    assert re.fullmatch(
        r"up to (0.\d+ l|\d+ ml): 1 subject, 1 flagged \(sub-0001 3.05 ml\)", lowest
    )
    assert re.fullmatch(r"1.\d+ l or more: 1 subject, 1 flagged \(sub-0020 9 l\)", highest)
    assert left.startswith("≤ " + lowest[len("up to ") : lowest.index(":")] + " (")
    assert right == "≥ " + highest[: highest.index(" or more")] + " (9 l)"

"""The report: everything a reader needs is on the page, what is undefined has its reason, files are whole."""

from __future__ import annotations

from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import pytest

from client.errors import OutputError
from server.document import Code, Heading, Picture, Table, Text, html_page, markdown
from server.events import LatencyFailed, PointFailed
from server.points import Flag, PointResult
from server.report import write_report
from tests.measured import latency_results, sweep_results

COMMAND = "gamesr-sweep map.mp4 --heights 540 --out 'a <b> & c'"


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    folder = tmp_path_factory.mktemp("report")
    points = sweep_results(heights=(540,))
    points[0] = PointResult(**{**vars(points[0]), "flags": (Flag.ABOVE,)})
    written = write_report(folder, points, latency_results(heights=(540,)), [], command=COMMAND)
    assert sorted(written) == sorted(folder.iterdir())
    names = {path.name for path in written}
    assert {"report.md", "report.html", "latency.png", "latency.svg", "rd_vmaf_540p.png", "rd_vmaf_540p.svg"} <= names
    assert [path.name for path in written[-2:]] == ["report.md", "report.html"]
    return (folder / "report.md").read_text(), (folder / "report.html").read_text()


def row(page: str, *cells: str) -> list[str]:
    """The cells of the first line of a Markdown table that begins with these."""
    line = next(line for line in page.splitlines() if line.startswith(f"| {' | '.join(cells)} |"))
    return line.strip("| ").split(" | ")


def test_the_page_says_how_it_came_about(pages: tuple[str, str]) -> None:
    page, _ = pages
    assert f"    {COMMAND}" in page
    for said in ("2 threads of a machine", "codec libx264", "tune zerolatency", "vbv-maxrate=2000", "av 18.1.0", "1920x1080"):
        assert said in page, said
    assert "LPIPS was not measured: no LPIPS model was given (--lpips FILE)." in page
    assert "their time on this CPU is not their time on a GPU" in page
    assert "![VMAF-NEG over bitrate, 540p upscaled and native resolution, one panel a clip](rd_vmaf_neg_540p.png)" in page


def test_the_tables_hold_figures_and_reasons(pages: tuple[str, str]) -> None:
    page, _ = pages
    against_bicubic = row(page, "gamesr 540p", "bicubic 540p")
    assert all(cell.startswith("-") and cell.endswith("%") for cell in against_bicubic[2:5])
    assert all(cell.startswith("+") for cell in against_bicubic[5:8])
    heads = next(line for line in page.splitlines() if "VMAF 70 (fair), kbps" in line)
    assert "saved over native" in heads and "over bicubic" in heads
    native = row(page, "native 1080p")
    assert native[2:4] == ["-", "-"]  # nothing is saved over itself
    assert "never reaches VMAF 90" in page
    assert "2040(" in page and "could not go down to the bitrate" in page
    missed = row(page, "fsr1 540p", "8123")
    assert missed[-4:] == ["100", "100", "100", "100"]
    assert row(page, "native 1080p", "8123")[4:6] == ["-", "-"]


def test_the_html_page_needs_no_other_file(pages: tuple[str, str]) -> None:
    _, page = pages
    sources: list[str] = []
    opened: list[str] = []

    class Reader(HTMLParser):
        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            sources.extend(str(value) for name, value in attrs if name in ("src", "href"))
            if tag not in ("meta", "img"):
                opened.append(tag)

        def handle_endtag(self, tag: str) -> None:
            assert opened.pop() == tag

    Reader().feed(page)
    assert opened == []
    assert len(sources) == 4 and all(source.startswith("data:image/svg+xml;base64,") for source in sources)
    assert "a &lt;b&gt; &amp; c" in page


def test_without_latencies_the_page_says_so(tmp_path: Path) -> None:
    write_report(tmp_path, sweep_results(("map",), (540,))[:10], [], [], command="gamesr-sweep")
    assert "Latency was not measured." in (tmp_path / "report.md").read_text()
    assert not (tmp_path / "latency.png").exists()


def test_what_could_not_be_measured_is_said_before_any_figure(tmp_path: Path) -> None:
    *points, missing = sweep_results(("map",), (540,))
    failures = [PointFailed(missing.point, "no <memory>", "trace"), LatencyFailed("map", 1080, "none", "no time", "trace")]
    write_report(tmp_path, points, [], failures, command="gamesr-sweep")
    page = (tmp_path / "report.md").read_text()
    assert "1 points and 1 latencies could not be measured" in page
    assert page.index("What is missing") < page.index("How it was measured") and "trace" not in page
    assert row(page, "map", "gamesr 540p", "25000") == ["map", "gamesr 540p", "25000", r"no \<memory>"]
    assert row(page, "map", "native 1080p", "latency")[-1] == "no time"


def test_a_clips_name_that_the_font_has_not_is_no_warning(tmp_path: Path) -> None:
    """Every warning is an error here, and this one would come once for each letter and figure."""
    points = [replace(result, point=replace(result.point, clip="\u65e5\u672c")) for result in sweep_results(("map",), (540,))[:10]]
    write_report(tmp_path, points, [], [], command="gamesr-sweep")
    assert "\u65e5\u672c" in (tmp_path / "report.md").read_text()


def test_a_report_that_cannot_be_written_leaves_the_old_one(tmp_path: Path) -> None:
    (tmp_path / "report.md").write_text("old")
    (tmp_path / "rd_vmaf_540p.svg").mkdir()
    with pytest.raises(OutputError, match=r"cannot write .*rd_vmaf_540p\.svg"):
        write_report(tmp_path, sweep_results(("map",), (540,))[:10], [], [], command="gamesr-sweep")
    assert (tmp_path / "report.md").read_text() == "old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rd_vmaf_540p.svg", "report.md"]


def test_text_is_never_taken_for_markup() -> None:
    blocks = [Heading(2, "a_b_c *d*"), Text("<i> [x](y)"), Code("x | <y>"), Table(["a|b", "c"], [["1", "2|3"]], title="<t>")]
    page = markdown([*blocks, Picture("name", "what", b"<svg/>")])
    assert r"## a\_b\_c \*d\*" in page and r"\<i> \[x\](y)" in page and "    x | <y>" in page
    assert r"| a\|b | c |" in page and r"| 1 | 2\|3 |" in page and "<summary>&lt;t&gt;</summary>" in page
    assert "![what](name.png)" in page
    assert "<i>" not in html_page("t", blocks) and "&lt;i&gt;" in html_page("t", blocks)

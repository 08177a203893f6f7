"""docs/paper.md and the README: their commands can be typed, their files exist, their figures are those of the rows."""
from __future__ import annotations

import re
import shlex
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAPER = ROOT / "docs" / "paper.md"
BENCHMARKS = ROOT / "benchmarks"
TOOLS = {"dsmoe_fit2d": "fit2d_main.cpp", "dsmoe_occluder": "occluder_main.cpp", "dsmoe_render": "render_main.cpp"}
sys.path.insert(0, str(BENCHMARKS))
import tables  # noqa: E402


def commands(text):
    """The commands of a page: in backticks and in indented lines, without comments."""
    found = re.findall(r"`((?:dsmoe\w*|python|\./\w+) [^`]*)`", text)
    found += re.findall(r"^ {4}((?:dsmoe\w*|python|\./\w+) .*)$", text, re.MULTILINE)
    return [shlex.split(command, comments=True) for command in found]


def rows_of(text, first):
    """The lines of the tables whose first cell begins so."""
    return [line for line in text.splitlines() if re.match(rf"\| \**{first}\b", line)]


@pytest.mark.parametrize("first", ["Eq. 1, 2", "Eq. 3", "Eq. 4", "Eq. 6", "Eq. 7", "Eq. 8", "-T_n,d", "Table 1",
                                   "Table 2", "Table 3", "2:", "3:", "4:", "5:", "8:", "10:"])
def test_each_piece_of_the_paper_has_a_row_with_a_command(first):
    first = re.escape(first).rstrip(":") if first.endswith(":") else re.escape(first)
    row, = rows_of(PAPER.read_text(encoding="utf-8"), first)
    assert re.search(r"`(dsmoe|--blend-mode)", row)


def test_every_command_of_the_readme_is_one():
    from dsmoe.arguments import build_parser

    typed = [" ".join(words).split(" && ") for words in commands((ROOT / "README.md").read_text(encoding="utf-8"))
             if words[0] == "dsmoe" and len(words) > 2]  # a name is no command
    assert len(typed) > 10
    for command in (command for line in typed for command in line):
        build_parser().parse_args(command.split()[1:])


def test_every_command_of_the_map_is_one():
    from dsmoe.arguments import build_parser
    from dsmoe.bench.names import SCENES, SHIPPED

    text = PAPER.read_text(encoding="utf-8")
    typed, wrong = commands(text), []
    for words in typed:
        program, options = words[0], [word for word in words if word.startswith("-") and len(word) > 1]
        if program == "dsmoe":
            try:
                asked = build_parser().parse_args(words[1:])
            except SystemExit:
                wrong.append(words)
                continue
            if words[1:3] == ["bench", "run"]:
                assert asked.suite in SHIPPED and (not asked.scenes or asked.scenes in SCENES), words
        elif program in TOOLS:
            source = (ROOT / "tools" / TOOLS[program]).read_text(encoding="utf-8")
            wrong += [words for option in options if len(option) > 2 and f'{{"{option[2:]}"' not in source]
            wrong += [words for option in options if len(option) == 2 and f"'{option[1]}'" not in source]
        else:
            source = (ROOT / (words[1] if program == "python" else program)).read_text(encoding="utf-8")
            wrong += [words for option in options if option not in source
                      and (program, option) != ("./check", "-k")]  # pytest's
    assert not wrong
    assert {words[0] for words in typed} >= {"dsmoe", "dsmoe_fit2d", "dsmoe_occluder", "python", "./check"}
    suites = {words[3] for words in typed if words[:3] == ["dsmoe", "bench", "run"]}
    assert suites >= {"table1", "table2", "table3", "fig4", "fig5"}


def test_options_that_stand_alone_are_options_of_a_training():
    from dsmoe.arguments import build_parser

    alone = [text for text in re.findall(r"`(--[^`]*)`", PAPER.read_text(encoding="utf-8"))
             if not text.startswith("--blend_mode")]  # of patched trainers
    assert len(alone) > 5
    for text in alone:
        words = [word for word in text.split() if word != "--scenes" and word != "captures"]
        build_parser().parse_args(["train", "SCENE", "-o", "OUT", *words])


def test_the_paper_is_what_the_page_says_it_is():
    from dsmoe.arguments import build_parser
    from dsmoe.options.config_arguments import given_options, take_paper

    said, = re.findall(r"`--paper` is `([^`]*)`", " ".join(PAPER.read_text(encoding="utf-8").split()))
    parsed = [build_parser().parse_args(["train", "SCENE", "-o", "OUT", *words])
              for words in (["--paper"], said.split())]
    for arguments in parsed:
        take_paper(arguments)
    assert given_options(parsed[0]) == given_options(parsed[1])


def test_every_file_of_the_map_and_of_the_method_is_there():
    for page in (PAPER, ROOT / "docs" / "method.md"):
        paths = re.findall(r"`([\w.-]+(?:/[\w.-]+)+)`", page.read_text(encoding="utf-8"))
        assert len(paths) > 5 and not [path for path in paths if not (ROOT / path).exists()], page


def test_what_the_map_names_in_blend_h_is_there():
    source = (ROOT / "diff_smoe_rasterization" / "include" / "dsmoe" / "blend.h").read_text(encoding="utf-8")
    named = re.findall(r"blend\.h`: ((?:`[^`]*`(?:, )?)+)", PAPER.read_text(encoding="utf-8"))
    names = [name for some in named for name in re.findall(r"`([^`]*)`", some)]
    assert {f"Blend<BlendMode::k{mode}>" for mode in ("Alpha", "Smoe", "SmoeEq7", "SmoeTn", "SmoeStd")} <= set(names)
    assert not [name for name in names
                if not re.search(rf"(?:struct|PairWeight<Real>|PairGradient<Real>) {name}[ (]", source)]


def test_the_caption_of_the_edge_has_what_its_table_has():
    row, = rows_of(PAPER.read_text(encoding="utf-8"), r"0\.25, 600")
    caption = re.search(r"edge\.png\)\n\n(.*?)\n\n", (ROOT / "README.md").read_text(encoding="utf-8"), re.DOTALL)
    figures = re.findall(r"\d\d\.\d", row)
    assert len(figures) == 4 and set(figures) <= set(re.findall(r"\d\d\.\d", caption.group(1)))


@pytest.mark.skipif(not any(tables.RESULTS.glob("*.jsonl")),
                    reason="the rows are in the repository, not in its source distribution")
def test_what_the_pages_say_in_sentences_is_in_the_rows():
    for page, texts in tables.sentences().items():
        said = " ".join((ROOT / page).read_text(encoding="utf-8").split())
        assert len(texts) > 1
        assert not [text for text in texts if text not in said], f"{page}: see `python benchmarks/tables.py`"


def test_a_range_whose_ends_are_printed_alike_is_one_number():
    assert tables.span([3.4, 1.2, 2.0], 1) == "1.2 to 3.4" and tables.span([13.8, 14.2]) == "14"
    assert tables.span([-0.04, 0.16], 1, "+") == "+0.0 to +0.2"


def test_a_number_at_a_psnr_is_interpolated_in_its_logarithm():
    assert tables.number_at([(100, 20.0), (10_000, 30.0), (20_000, 29.0)], 25.0) == pytest.approx(1000)
    assert tables.number_at([(100, 20.0), (400, 30.0)], 31.0) is None


def test_trainers_are_compared_where_their_sizes_and_their_quality_overlap(monkeypatch):
    """alpha has 10 dB for each factor of 10, from 1 to 100 MB; smoe lies 2 dB higher, from 10 to 1,000 MB."""
    def row(size, psnr):
        return {"size_bytes": {"own": size * 1e6}, "psnr": psnr}

    rules = {"sparse": {"alpha": row(1, 20.0), "learned": row(10, 32.0)},
             "dense": {"alpha": row(100, 40.0), "learned": row(1000, 52.0)}}
    monkeypatch.setattr(tables, "plugged_rows", lambda: {("hac", end): found for end, found in rules.items()})
    gains, sizes = tables.equal_size("hac", "learned")
    assert gains == pytest.approx([2, 2]) and sizes == pytest.approx([100 * (10**-0.2 - 1)] * 2)


@pytest.mark.slow
def test_the_edge_has_the_figures_of_the_pages(tmp_path):
    """README and docs/paper.md, within what another processor may round otherwise in 600 steps."""
    from test_examples import run

    readme = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    said = [float(value) for value in re.findall(r"([\d.]+) dB by `(?:alpha|smoe)`", readme)[:2]]
    by_picture = [float(value) for value in re.findall(r"([\d.]+) dB", run("edge.py", folder=tmp_path))[:2]]
    assert said == pytest.approx(by_picture, abs=0.3)
    rules = [float(value) for value in re.findall(r"([\d.]+) dB", run("edge.py", "--rules", folder=tmp_path))]
    rows = rows_of(PAPER.read_text(encoding="utf-8"), r"(?:0\.25|1), 600")
    of_page = [float(value) for row in rows for value in re.findall(r"\d\d\.\d", row)]
    assert len(rules) == len(of_page) == 8 and of_page == pytest.approx(rules, abs=0.5)

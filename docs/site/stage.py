"""Puts the repository's pages, and what they link to, where MkDocs reads them; makes the pages of the C++ headers.

python stage.py FOLDER writes FOLDER/mkdocs.yml and FOLDER/pages. Every page lies there where it lies in the repository,
so its links work as they are; a link to a folder leads to its README.md, or to a list of its files.
"""
from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Iterator, List

ROOT = Path(__file__).resolve().parents[2]
SITE = Path(__file__).resolve().parent
LINK = re.compile(r"\]\(([^)#\s]+)[^)]*\)")
INCLUDE = ROOT / "diff_smoe_rasterization" / "include" / "dsmoe"
IO = ROOT / "diff_smoe_rasterization" / "csrc" / "io"

# The headers in the order in which one reads them; others follow by name.
FIRST = ("rasterize.h", "rasterize_cuda.h", "params.h", "allocator.h", "torch.h")
DEMO = "DSMOE_DEMO"  # names the page of `dsmoe export` that the site shows; the repository holds no model
IO_HEADERS = ("ply.h", "colmap.h")


def main(folder: Path) -> None:
    """Writes everything anew."""
    shutil.rmtree(folder, ignore_errors=True)
    pages = folder / "pages"
    for page in markdown_files():
        text = page.read_text(encoding="utf-8")
        for target in {*LINK.findall(text)}:
            path = (page.parent / target).resolve()
            if ROOT not in path.parents:
                continue
            if path.is_dir():
                text = text.replace(f"]({target})", f"]({target.rstrip('/')}/README.md)")
                write_listing(path, pages)
            elif path.is_file() and path.suffix != ".md":
                copy(path, pages)
        write(pages / page.relative_to(ROOT), text)
    write(pages / "docs" / "site" / "cpp_headers.md", header_pages())
    copy(SITE / "site.css", pages)
    if os.environ.get(DEMO):
        shutil.copyfile(os.environ[DEMO], pages / "docs" / "demo.html")
        for page, target in (("README.md", "docs/demo.html"), ("docs/look.md", "demo.html")):
            title, text = (pages / page).read_text(encoding="utf-8").split("\n", 1)
            write(pages / page, f"{title}\n\n[A model to turn with the mouse]({target}).\n{text}")
    settings = (SITE / "mkdocs.yml").read_text(encoding="utf-8")
    write(folder / "mkdocs.yml", settings.replace("REPOSITORY", str(ROOT)))


def markdown_files() -> Iterator[Path]:
    """The pages that git knows, or would take; without git all that lie in the folders that have pages."""
    try:
        listed = subprocess.run(["git", "-C", str(ROOT), "ls-files", "-co", "--exclude-standard", "*.md"], check=True,
                                stdout=subprocess.PIPE, universal_newlines=True).stdout.splitlines()
    except (OSError, subprocess.CalledProcessError):
        found = [*ROOT.glob("*.md")]
        for name in ("docs", "examples", "benchmarks", "integrations", "patches"):
            found += (ROOT / name).rglob("*.md")
        listed = [str(path.relative_to(ROOT)) for path in found]
    return (ROOT / name for name in sorted(listed) if (ROOT / name).is_file() and not name.startswith("tests/"))


def write_listing(folder: Path, pages: Path) -> None:
    """The page of a folder that another page links to, if it has none: its files."""
    if (folder / "README.md").is_file():
        return
    files = [path for path in sorted(folder.iterdir()) if path.is_file()]
    for path in files:
        copy(path, pages)
    name = folder.relative_to(ROOT)
    write(pages / name / "README.md", f"# {name}\n\n" + "".join(f"- [{path.name}]({path.name})\n" for path in files))


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def copy(path: Path, pages: Path) -> None:
    target = pages / path.relative_to(ROOT)
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, target)


def header_pages() -> str:
    """One page with every public header: its comments and its declarations, bodies of functions left out."""
    names = [name for name in FIRST if (INCLUDE / name).is_file()]
    names += sorted({path.relative_to(INCLUDE).as_posix() for path in INCLUDE.rglob("*.h")} - {*FIRST})
    headers = [(f"dsmoe/{name}", INCLUDE / name) for name in names]
    headers += [(f"io/{name}", IO / name) for name in IO_HEADERS]
    lines = ["# C++", "", "The public headers, with their comments; bodies of functions are left out. [C++ without",
             "torch](../cpp.md) says how to build against them. `DSMOE_HD` marks what compiles for host and device."]
    for name, path in headers:
        text = path.read_text(encoding="utf-8")
        lines += ["", f"## {name}", "", *introduction(text), "", "```cpp", *declarations(text), "```"]
    return "\n".join(lines) + "\n"


def introduction(text: str) -> List[str]:
    """The comment at a header's top, as a paragraph; its indented lines stay code."""
    lines: List[str] = []
    for line in text.splitlines():
        if not line.startswith("//"):
            break
        content = line[2:]
        lines.append(content[1:] if content.startswith("     ") else content.strip())
    return lines


def declarations(text: str) -> List[str]:
    """What stands between a header's includes and its end, with the body of each function made a semicolon."""
    begin = re.search(r"^namespace dsmoe", text, re.MULTILINE)
    lines = text[begin.start():].splitlines() if begin else []
    out: List[str] = []
    inside_body = False  # of a function; Google style closes it by a brace at the depth where it began
    indent = 0
    for line in lines:
        depth = len(line) - len(line.lstrip())
        if inside_body:
            if line.strip().startswith("}") and depth == indent:
                inside_body = False
            continue
        opens = re.match(r"^(?!.*\b(struct|class|enum|union|namespace)\b[^()]*\{$)(.*\)[^{}]*)\{(.*)$", line)
        if not opens or line.strip().startswith("//"):
            out.append(line)
            continue
        out.append(opens.group(2).split(" : ")[0].rstrip() + ";")
        if line.count("{") > line.count("}"):
            inside_body = True
            indent = depth if not line.startswith("    ") or depth < 4 else _beginning(out)
    return out


def _beginning(out: List[str]) -> int:
    """The indentation of the declaration that the last line continues."""
    for line in reversed(out[:-1]):
        depth = len(line) - len(line.lstrip())
        if depth < 4 and line.strip():
            return depth
    return 0


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())

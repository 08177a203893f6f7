"""What `dsmoe patch` says: with its options, where there is nothing to do, and where it is typed wrongly."""
from __future__ import annotations

import shlex
import shutil

import pytest

pytest.importorskip("libcst", reason="patching needs LibCST: pip install libcst")

from diff_smoe_rasterization import patches  # noqa: E402
from diff_smoe_rasterization.patches import record as record_module  # noqa: E402
from test_patch_engine import make, snapshot  # noqa: E402


def test_a_dry_run_shows_what_is_still_to_be_done(tmp_path, dsmoe):
    checkout = make(tmp_path)
    assert "+++ b/train.py" in dsmoe("patch", "apply", checkout, "--dry-run").out
    patches.apply(checkout)
    before = snapshot(checkout)
    said = dsmoe("patch", "apply", checkout, "--dry-run")
    assert said.status == 0 and "already patched" in said.out and "would be written" in said.out
    assert "+++" not in said.out
    said = dsmoe("patch", "apply", checkout, "--dry-run", "--modernise")
    assert "+++ b/train.py" in said.out and "weights_only" in said.out and "blend_of" not in "".join(
        line for line in said.out.splitlines() if line[0] == "+")
    assert snapshot(checkout) == before


def test_a_diff_without_the_originals_says_so(tmp_path, dsmoe):
    checkout = make(tmp_path)
    patches.apply(checkout)
    assert dsmoe("patch", "diff", checkout).err == ""
    shutil.rmtree(str(checkout / ".dsmoe_patch"))
    said = dsmoe("patch", "diff", checkout)
    assert said.status == 0 and said.out == "" and "not known without .dsmoe_patch" in said.err


def test_check_has_the_options_of_apply_and_names_what_it_would(tmp_path, dsmoe):
    checkout = make(tmp_path, {"film.py": "from gaussian_renderer import render\n"})
    before = snapshot(checkout)
    said = dsmoe("patch", "check", checkout, "--modernise")
    assert said.status == 0 and "film.py: renders" in said.out
    assert "modernise checkpoint-load: not applied in train.py: " in said.out
    assert ": patchable (3dgs-2023)" in dsmoe("patch", "check", checkout, "--trainer", "3dgs-2023").out
    assert dsmoe("patch", "check", checkout, "--trainer", "hac").status == 1
    assert snapshot(checkout) == before


LOAD = "checkpoint = torch.load(path)\n"


def test_check_says_of_each_modernising_rule_whether_it_is_applied_and_what_to_type(tmp_path, dsmoe):
    checkout = make(tmp_path / "a checkout", {"utils/loading.py": LOAD})
    patches.apply(checkout)
    assert "modernise" not in dsmoe("patch", "check", checkout).out
    said = dsmoe("patch", "check", checkout, "--modernise")
    assert said.status == 0 and ": patched (3dgs-2023)" in said.out
    assert "modernise checkpoint-load: not applied in train.py, utils/loading.py: torch 2.6" in said.out
    typed = shlex.split(said.out.splitlines()[-1].partition("type: ")[2])
    assert typed[0] == "dsmoe" and dsmoe(*typed[1:]).status == 0
    for words in ([], ["--modernise"]):
        said = dsmoe("patch", "check", checkout, *words)
        assert "modernise checkpoint-load: applied in train.py, utils/loading.py: torch 2.6" in said.out
        assert "not applied" not in said.out and "type: " not in said.out
    (checkout / "film.py").write_text(LOAD)
    said = dsmoe("patch", "check", checkout)
    assert "applied in train.py, utils/loading.py, not applied in film.py: " in said.out and "type: " in said.out


def test_check_says_that_an_edit_keeps_a_rule_from_being_applied(tmp_path, dsmoe):
    checkout = make(tmp_path, {"utils/loading.py": LOAD})
    patches.apply(checkout, modernise=True)
    modernised = (checkout / "utils/loading.py").read_text()
    (checkout / "utils/loading.py").write_text("from diff_smoe_rasterization import io\n" + LOAD)
    for words in (["check"], ["apply", "--modernise"]):
        said = dsmoe("patch", *words, checkout)
        assert "every rule for the blend mode is still applied" in said.out
        assert "modernise checkpoint-load: applied in train.py, not applied in utils/loading.py: " in said.out
        assert "undo your edit of patched files, then type: dsmoe patch apply --modernise" in said.out
    (checkout / "utils/loading.py").write_text(modernised)
    patches.revert(checkout)
    patches.apply(checkout)
    with open(str(checkout / "train.py"), "a") as file:
        file.write("# mine\n")
    said = dsmoe("patch", "check", checkout, "--modernise")
    assert said.status == 0 and "not applied in train.py" in said.out
    assert "cannot be applied as it is: train.py: was changed since it was patched: undo your edit" in said.out


def test_a_file_with_a_null_byte_is_named_in_words(tmp_path, dsmoe):
    checkout = make(tmp_path)
    (checkout / "film.py").write_bytes(b"import diff_gaussian_rasterization\n\0x")
    said = dsmoe("patch", "check", checkout)
    assert "film.py: is not Python that can be parsed: " in said.out and "null byte" in said.out
    assert "line None" not in said.out


@pytest.mark.parametrize("words, usage", [(["patch", "apply"], "usage: dsmoe patch apply "),
                                          (["patch", "revert"], "usage: dsmoe patch revert "),
                                          (["eval"], "usage: dsmoe eval ")])
def test_an_option_that_there_is_not_shows_the_usage_of_the_command(tmp_path, dsmoe, words, usage):
    said = dsmoe(*words, tmp_path, "--modernize")
    assert said.status == 2 and usage in said.err and "--modernize" in said.err


def test_a_record_that_may_not_be_read_is_named(tmp_path, monkeypatch, dsmoe):
    checkout = make(tmp_path)
    patches.apply(checkout)

    def forbidden(path, **options):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(record_module.Path, "read_text", forbidden)  # root reads everything
    said = dsmoe("patch", "check", checkout)
    assert said.status == 1 and "the record of the patch cannot be read: [Errno 13] Permission denied" in said.err

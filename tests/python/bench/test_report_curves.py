"""The report's figures show the means and spreads of the rows."""
from __future__ import annotations

import pytest
from report_rows import failed, row

pytest.importorskip("matplotlib", reason="figures need matplotlib")
from diff_smoe_rasterization.benchmarks.suite.report import curves, groups, layouts  # noqa: E402


@pytest.fixture(autouse=True)
def closed_figures():
    yield
    curves.plt.close("all")


def groups_of(entries):
    return groups.grouped(entries, layouts.end_of)


def test_a_curve_goes_through_the_means_from_few_gaussians_to_many():
    entries = [row(threshold=0.0002, psnr=30.0, num_gaussians=900),
               row(threshold=0.005, psnr=20.0, num_gaussians=100), row(seed=1, psnr=22.0, num_gaussians=300),
               row(blend_mode="smoe", psnr=25.0, num_gaussians=50)]
    axes = curves.rate_distortion(groups_of(entries)).axes
    # Rows: PSNR, SSIM, LPIPS; columns: number, own size, common size.
    assert [axis.get_ylabel() for axis in axes[::3]] == ["PSNR [dB]", "SSIM", "LPIPS Alex (lower is better)"]
    assert [axis.get_xlabel() for axis in axes[-3:]] == ["#Gaussians", "own size [MB]", "common size [MB]"]
    alpha, smoe = (container.lines[0].get_xydata().tolist() for container in axes[0].containers)
    assert alpha == [[200, 21], [900, 30]] and smoe == [[50, 25]]
    whisker = axes[0].containers[0].lines[2][0].get_segments()[0]
    assert whisker[1, 1] - whisker[0, 1] == pytest.approx(2 * 2 ** 0.5)  # seeds 20 and 22: sd is the root of 2


def test_what_has_no_place_on_an_axis_is_left_out():
    entries = [row(psnr=float("inf")), row(threshold=0.002, num_gaussians=0), row(threshold=0.001, num_gaussians=7)]
    psnr = curves.rate_distortion(groups_of(entries)).axes[0]
    assert [line.get_xydata().tolist() for line in psnr.containers[0].lines[:1]] == [[[7, 20]]]
    nothing = [row(num_gaussians=0, size_bytes={"own": 0, "common": 0})]
    assert curves.rate_distortion(groups_of(nothing)) is None


def test_the_legend_lies_inside_and_above_the_panels():
    entries = [row(blend_mode=mode, label=f"{'a long name of method ' * 2}{method}", schedule="steady",
                   threshold=threshold)
               for mode in ("alpha", "smoe") for method in range(4) for threshold in (0.005, 0.0002)]
    drawn = curves.rate_distortion(groups_of(entries))
    drawn.canvas.draw()
    box = drawn.legends[0].get_window_extent()
    assert box.x0 >= 0 and box.x1 <= drawn.bbox.x1 and box.y1 <= drawn.bbox.y1
    assert box.y0 >= max(axis.get_window_extent().y1 for axis in drawn.axes)


def test_what_was_not_measured_is_not_drawn(tmp_path):
    nothing = row(psnr=None, ssim=None, lpips=None, train_seconds=None, fps=None)
    assert curves.draw_all("table1", groups_of([nothing, failed(scene="fox")]), str(tmp_path)) == []

"""What a training writes for TensorBoard, if that is installed."""
from __future__ import annotations

import pytest

from dsmoe.results import scalars
from dsmoe.train import train


@pytest.fixture
def no_tensorboard():
    """Here it is used if it is installed."""


def test_without_tensorboard_nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr(scalars, "is_installed", lambda: False)
    log = scalars.Scalars(str(tmp_path), 0)
    log.add(1, loss=1.0)
    log.close()
    assert not log.active and not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_training_writes_what_its_progress_shows(tiny_config):
    loading = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    row = train(tiny_config.changed(eval_every=20), progress=False)
    shown = loading.EventAccumulator(tiny_config.output + "/tensorboard").Reload()
    assert set(shown.Tags()["scalars"]) == {"loss", "psnr", "gaussians", "gate", "test/psnr", "test/ssim",
                                            "test/psnr_float"}
    assert [event.step for event in shown.Scalars("loss")] == [10, 20, 30, 40]
    assert shown.Scalars("gaussians")[-1].value == row["num_gaussians"]
    assert shown.Scalars("gate")[-1].value == pytest.approx(row["background_gate"])
    assert [event.step for event in shown.Scalars("test/psnr")] == [20]

    train(tiny_config.changed(eval_every=20), overwrite=True, progress=False)
    again = loading.EventAccumulator(tiny_config.output + "/tensorboard").Reload()
    assert [event.step for event in again.Scalars("loss")] == [10, 20, 30, 40], "of one run only"

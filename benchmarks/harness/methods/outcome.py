"""What a method is given and what it returns."""
from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Dict, List, Optional

import torch

from ...options.config import TrainConfig
from ...results.evaluation import Evaluation
from ...scenes.scene import Scene, load_scene
from ..errors import BenchError
from ..protocol import BYTES_PER_GAUSSIAN


@dataclass
class Outcome:
    scene: Scene
    evaluation: Evaluation
    lpips: List[Dict[str, Any]]  # a row {value, kind, reason} for each kind asked for
    num_gaussians: int
    own_bytes: Optional[int]  # in the method's own container
    train_seconds: Optional[float]
    peak_gpu_mib: Optional[float]
    are_gaussians: bool = True  # those of 3DGS, which fit into the container that all methods are compared in
    commit: Optional[str] = None  # of the checkout
    history: List[Dict[str, Any]] = field(default_factory=list)
    renders: Dict[str, torch.Tensor] = field(default_factory=dict)  # [3, H, W] of the test views whose images are kept
    notes: Dict[str, Any] = field(default_factory=dict)  # of the row's protocol: further or other entries

    @property
    def common_bytes(self) -> Optional[int]:
        return self.num_gaussians * BYTES_PER_GAUSSIAN if self.are_gaussians else None


def scene_of(config: TrainConfig) -> Scene:
    """Raises BenchError, before anything is trained, if there would be nothing to measure."""
    scene = load_scene(config, progress=False)
    if not scene.test:
        raise BenchError(f"scene {config.scene} has no test views: nothing could be measured")
    return scene

import torch


def points_on_screen(positions):
    """[N, 3] zeros whose gradient after the backward pass is that of the positions on the screen."""
    points = torch.zeros_like(positions, requires_grad=torch.is_grad_enabled())
    return points


def shape_arguments(pc, pipe, scaling_modifier):
    """Scales and rotations, or covariances where the pipeline computes them in Python."""
    if pipe.compute_cov3D_python:
        return {"scales": None, "rotations": None, "cov3D_precomp": pc.get_covariance(scaling_modifier)}
    return {"scales": pc.get_scaling, "rotations": pc.get_rotation, "cov3D_precomp": None}

"""The part of this package that HAC asks for."""


def scatter_max(values, index, dim):
    """The largest value of each index along dim 0, and the row that it is in."""
    import torch

    size = [int(index.max()) + 1, *values.shape[1:]]
    largest = torch.full(size, float("-inf")).scatter_reduce(dim, index, values, "amax")
    rows = torch.arange(len(values))[:, None].expand_as(values)
    first = torch.full(size, len(values)).scatter_reduce(
        dim, index, torch.where(values == largest.gather(dim, index), rows, len(values)), "amin")
    return largest, first

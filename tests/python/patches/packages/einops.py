"""The part of this package that HAC asks for."""


def repeat(tensor, pattern, k):
    if pattern != "n (c) -> (n k) (c)":
        raise NotImplementedError(pattern)
    return tensor.repeat_interleave(k, dim=0)

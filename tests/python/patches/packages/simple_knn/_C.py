"""The package that trainers ask for by this name, on this project's own search."""


def distCUDA2(points):
    from diff_smoe_rasterization import distCUDA2 as search

    return search(points)

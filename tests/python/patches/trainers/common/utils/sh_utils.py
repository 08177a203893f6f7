DEGREE_0 = 0.28209479177387814  # 1 / (2 sqrt(pi))


def RGB2SH(rgb):
    return (rgb - 0.5) / DEGREE_0

import torch


def rounded(rows):
    """The distinct rows of [N, D], rounded to fifths, and which of them each row is."""
    return torch.unique((5 * rows).round() / 5, dim=0, return_inverse=True)


class Compressed:
    """What a model of codebooks has beside a trained one."""

    indices = None

    def compress(self, importance):
        """Drops what no view needs, and puts colours and shapes into codebooks."""
        rows = {name: values[importance > 0] for name, values in self.rows().items()}
        colors, of_colors = rounded(torch.cat([rows["f_dc"], rows["f_rest"]], dim=1).flatten(1))
        shapes, of_shapes = rounded(torch.cat([rows["scaling"], rows["rotation"]], dim=1))
        colors = colors.unflatten(1, (-1, 3))
        self.set_rows({**rows, "f_dc": colors[:, :1], "f_rest": colors[:, 1:], "scaling": shapes[:, :3],
                       "rotation": shapes[:, 3:]})
        self.indices = of_colors, of_shapes

import torch


class Adam:
    """Adam as in torch.optim, whose first use imports all of torch._dynamo: seconds, in every process of a test."""

    def __init__(self, params, lr, eps):
        self.param_groups = [{"lr": lr, **group} for group in params]
        self.state = {}
        self.eps = eps

    @torch.no_grad()
    def step(self):
        for group in self.param_groups:
            for tensor in group["params"]:
                if tensor.grad is None:
                    continue
                state = self.state.setdefault(tensor, {"step": 0, "exp_avg": torch.zeros_like(tensor),
                                                       "exp_avg_sq": torch.zeros_like(tensor)})
                state["step"] += 1
                state["exp_avg"].lerp_(tensor.grad, 0.1)
                state["exp_avg_sq"].lerp_(tensor.grad ** 2, 0.001)
                mean = state["exp_avg"] / (1 - 0.9 ** state["step"])
                square = state["exp_avg_sq"] / (1 - 0.999 ** state["step"])
                tensor -= group["lr"] * mean / (square.sqrt() + self.eps)

    def zero_grad(self, set_to_none=True):
        for group in self.param_groups:
            for tensor in group["params"]:
                tensor.grad = None

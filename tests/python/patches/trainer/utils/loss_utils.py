from torch.nn.functional import avg_pool2d


def l1_loss(network_output, gt):
    return (network_output - gt).abs().mean()


def ssim(img1, img2):
    """Mean SSIM of two [C, H, W] images over 5x5 boxes."""
    def mean(image):
        return avg_pool2d(image[None], 5, stride=1)

    mean1, mean2 = mean(img1), mean(img2)
    variances = mean(img1 * img1) - mean1 ** 2 + mean(img2 * img2) - mean2 ** 2
    covariance = mean(img1 * img2) - mean1 * mean2
    luminance = (2 * mean1 * mean2 + 1e-4) / (mean1 ** 2 + mean2 ** 2 + 1e-4)
    return (luminance * (2 * covariance + 9e-4) / (variances + 9e-4)).mean()

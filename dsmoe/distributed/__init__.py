"""One scene trained by several processes, each with a part of the Gaussians; and batches of views on one."""

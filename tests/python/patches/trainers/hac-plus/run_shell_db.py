import os

for lmbda in (0.004,):
    rate = min(0.5 * lmbda, 0.0015)
    command = f"CUDA_VISIBLE_DEVICES={0} python train.py -s data/db/chairs --eval --lod 0 --voxel_size 0.1"
    if os.system(command + f" -m outputs/db/chairs/{lmbda} --lmbda {lmbda} --mask_lr_final {rate}") != 0:
        raise SystemExit("training failed")

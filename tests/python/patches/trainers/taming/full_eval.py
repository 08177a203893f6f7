import os
from argparse import ArgumentParser

SCENES = ("chairs",)


def call(command):
    if os.system(command) != 0:
        raise SystemExit(f"failed: {command}")


flags = ArgumentParser(description="Trains and renders the scenes of a folder.")
flags.add_argument("--madeup", "-mu", required=True)
flags.add_argument("--output_path", default="eval")
flags.add_argument("--skip_rendering", action="store_true")
args = flags.parse_args()

for name in SCENES:
    call("python train.py -s " + args.madeup + "/" + name + " -m " + args.output_path + "/" + name
         + " --eval --mode final_count --budget 400")
for name in () if args.skip_rendering else SCENES:
    call("python render.py --skip_train -m " + args.output_path + "/" + name)

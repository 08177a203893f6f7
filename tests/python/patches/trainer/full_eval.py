import os
import shlex
import sys

data, output = sys.argv[1:]
python = shlex.quote(sys.executable)
for command in (f"{python} train.py -s {data} -m {output} --quiet --eval", f"{python} render.py --skip_train -m {output}"):
    if os.system(command) != 0:
        raise SystemExit(f"failed: {command}")

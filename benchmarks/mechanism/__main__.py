"""python -I -m diff_smoe_rasterization.benchmarks.mechanism run|plot ..."""
import sys

from .record import main

sys.exit(main())

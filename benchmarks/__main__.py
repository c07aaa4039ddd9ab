"""``python -m benchmarks``: the demonstration over seeds and the measured sets, the tables of the README."""

import sys

from benchmarks import demo_seeds, measured_sets, readme

if __name__ == "__main__":
    sys.argv = sys.argv[:1]
    demo_seeds.main()
    measured_sets.main()
    readme.refresh()

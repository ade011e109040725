"""The command line as `python -m m3gn_bench`, which is what torchrun can start."""

from m3gn_bench.cli import run

if __name__ == "__main__":
    run()

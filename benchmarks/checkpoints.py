"""Evaluate the planners of `checkpoints/` as they are shipped: bfloat16 weights, their own settings.

python -m benchmarks.checkpoints
"""

import argparse
import json
import time

from .evaluation import evaluate
from .machine import REPOSITORY, RESULTS, describe_run, write_json

FIRST_SEED = 3_000_000
"""Of the starts; no evaluation during training has these."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--starts", type=int, default=200)
    options = parser.parse_args()
    results = []
    for config in sorted((REPOSITORY / "checkpoints").glob("*/config.json")):
        begin = time.monotonic()
        result = evaluate(config.parent, options.starts, FIRST_SEED)
        results.append(
            {
                "checkpoint": config.parent.name,
                "starts": options.starts,
                **result,
                "seconds": round(time.monotonic() - begin, 1),
            }
        )
        print(json.dumps(results[-1]))
    write_json(RESULTS / "checkpoints.json", {"run": describe_run(), "results": results})


if __name__ == "__main__":
    main()

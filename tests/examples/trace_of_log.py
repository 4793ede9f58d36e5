"""Example: turn the log of another engine into a trace that `kerv estimate trace=FILE` prices.

    PYTHONPATH=tests python -m examples.trace_of_log LOG TRACE

The log has a JSON object per request, as engines with speculative decoding write them: how many tokens were drafted and
how many accepted in every step after the prefill.
"""

import json
import sys
from pathlib import Path


def convert(log: Path, trace: Path) -> None:
    lines = []
    for request in map(json.loads, log.read_text().splitlines()):
        start, rounds = 1, [{"start": 0, "committed": 1}]  # the prefill gives the first token
        for drafted, accepted in zip(request["num_draft_tokens"], request["num_accepted_tokens"], strict=True):
            draft = {"proposer": "drafter", "parents": list(range(-1, drafted - 1)), "accepted": accepted}
            rounds.append({"start": start, "committed": accepted + 1, **(draft if drafted else {})})
            start += accepted + 1
        about = {"episode": request["session_id"], "setting": request["method"], "prompt": request["prompt_tokens"]}
        lines.append(json.dumps({**about, "tokens": start, "rounds": rounds}))
    trace.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    convert(Path(sys.argv[1]), Path(sys.argv[2]))

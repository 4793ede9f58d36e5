"""What somebody may have meant who typed a name that does not exist."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping

KEYS = {
    "demos": "data dataset demonstrations",
    "episodes": "n num_episodes n_episodes trials count",
    "log": "logger tracker wandb tensorboard trackio",
    "method": "algorithm algo decoder decoding",
    "policy": "agent",
    "policy.target": "model checkpoint ckpt weights pretrained",
    "record": "video save_video save_videos rrd",
    "rerun": "force overwrite fresh",
    "results": "o out output outdir output_dir save_dir dir folder",
    "runtime.device": "gpu cuda accelerator",
    "runtime.dtype": "precision fp16 bf16",
    "runtime.threads": "cpus cores",
    "runtime.workers": "j jobs parallel processes num_workers",
    "task": "t env env_name environment suite benchmark",
    "threshold.r": "radius tolerance relaxation",
    "train.batch": "batch_size",
    "train.lr": "learning_rate",
    "train.steps": "epochs iterations iters max_steps",
    "world.horizon": "max_steps max_episode_steps",
}
"""Setting -> what other programs call it."""
OPTIONS = {
    "--cfg": "config print_config show_config",
    "--multirun": "grid",
    "--plan": "dry_run dryrun",
    "--repair": "fix clean",
    "--to": "o out output save export",
}
COMMANDS = {
    "bench": "benchmark profile",
    "demos": "collect record demonstrations dataset",
    "doctor": "check diagnose status info",
    "prepare": "setup init",
    "report": "plot plots table tables summary",
    "rollout": "run eval evaluate test infer simulate",
    "runs list": "ls history",
    "runs rm": "delete remove",
    "serve": "server deploy start",
    "sweep": "study grid ablate experiment",
    "train drafter": "draft eagle",
    "train target": "fit learn finetune",
    "view": "open play watch visualize",
}


def nearest(name: str, known: Iterable[str], called: Mapping[str, str] | None = None) -> list[str]:
    """The known names that `name` may stand for, the nearest first: those of the same letters; else those that others
    call so, or that end in that word or key; else at most three that look alike; else those of each of its words.

    Args:
        called: known name -> what others call it.
    """
    known = list(dict.fromkeys(known))
    letters = _letters(name)
    same = [one for one in known if _letters(one) == letters]
    others = [one for one, words in (called or {}).items() if one in known and letters in map(_letters, words.split())]
    ends = [one for one in known if re.split(r"[. ]", one)[1:] and _letters(re.split(r"[. ]", one)[-1]) == letters]
    if same or others or ends:
        return same or list(dict.fromkeys([*ends, *others]))
    alike: dict[str, str] = {}
    for one in known:
        alike.setdefault(one.lower(), one)
    near = [alike[one] for one in difflib.get_close_matches(name.lower(), alike, n=3)]
    words = name.split() if not near else []
    return near or [one for word in words[1:] and words for one in nearest(word, known)[:1]]


def _letters(name: str) -> str:
    """A name without case and separators."""
    return re.sub(r"[\W_]", "", name).lower()


def question(near: Iterable[str], value: str = "") -> str:
    """`did you mean a=1 or b=1?`; empty where nothing is near."""
    words = [f"{one}{value}" for one in near]
    return f"did you mean {' or '.join(words)}?" if words else ""

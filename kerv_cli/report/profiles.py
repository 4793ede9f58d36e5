"""Cost profiles: the seconds of each operation of a decode, with the name that the user gave (docs/measuring.md).

This module needs neither torch nor pandas.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from kerv_cli.base.errors import CheckpointError, UsageError
from kerv_cli.base.paths import shipped_dir
from kerv_cli.episodes.cost import Profile, read_profile

_SHIPPED = "-profile.json"
_EIGHT_MS = 0.008  # what HeiSD's encoder takes on an A100 (arXiv 2603.17573)
# Table column with a speed per episode -> the time that the vision encoder is assumed to take, in words
ENCODERS = {"encoder_floor": "its floor", "encoder_twice": "twice its floor", "encoder_8ms": "8 ms"}


@dataclass(frozen=True)
class NamedProfile:
    """The costs of one target on one machine, from `kerv bench`, and the name that the user gave."""

    name: str
    profile: Profile
    # for `encode`, `prefill` and `verify` (of one further token), what takes most of the time, such as `reading` (the
    # weights). Empty if the costs were measured.
    bounds: Mapping[str, str] = field(default_factory=dict)

    @property
    def is_projected(self) -> bool:
        return bool(self.profile.about.get("projected"))

    @property
    def title(self) -> str:
        about = self.profile.about
        names = [str(about[key]) for key in ("target", "device_name", "engine") if about.get(key)]
        return ", ".join(names or [self.name]) + (", projected" if self.is_projected else "")

    @property
    def encoders(self) -> dict[str, Profile]:
        """For each key of `ENCODERS`, the same profile with another time of the vision encoder.

        The floor is the shortest time that the device's bandwidth and arithmetic allow. Empty if the profile has no
        floor.
        """
        about, phases = self.profile.about, self.profile.phases
        floor, system = about.get("encoder_floor"), float(about.get("encoder_system", 0.0))
        if not isinstance(floor, int | float):
            return {}
        profiles = {}
        for name, cost in zip(ENCODERS, (floor, 2 * floor, _EIGHT_MS), strict=True):
            profiles[name] = replace(self.profile, phases={**phases, "encode": ((1,), (cost + system,))})
        return profiles

    def check(self, tokens: int, kinds: Iterable[str] = (), setting: str = "") -> None:
        """Refuse a profile that lacks one of `kinds` or is for chunks below `tokens` tokens. Errors name `setting`."""
        about = self.profile.about
        target = about.get("target", "TARGET")
        if lacks := self.profile.lacks(kinds):
            reason = f"no cost of '{lacks[0]}'" + (f", which setting '{setting}' needs" if setting else "")
        elif self.profile.tokens < tokens:
            reason = f"its costs are for chunks of {self.profile.tokens} tokens"
            reason += f", setting '{setting}' decodes {tokens}" if setting else ""
            target = target if about.get("random_weights") else "vla-150m"  # a policy's chunk has as many as it has
        else:
            return
        command = f"kerv bench target={target} tokens={tokens}"
        raise UsageError(f"on={self.name}: {reason}. Measure it with '{command}'")


def open_profiles(results: Path | str, names: Iterable[str]) -> list[NamedProfile]:
    """Read cost profiles. A name is a path, a file in <results>/bench, or a profile that kerv ships."""
    folders = (Path(results) / "bench", shipped_dir().parent / "bench")
    profiles = []
    for name in names:
        paths = [Path(name).expanduser()]
        for folder in folders:
            paths += (folder / f"{name}.json", folder / f"{name}{_SHIPPED}")
        path = next(filter(Path.is_file, paths), None)
        if path is None:
            known: set[str] = set()
            for folder in folders:
                known.update(path.name.removesuffix(_SHIPPED) for path in folder.glob(f"*{_SHIPPED}"))
            others = f", or take one of {', '.join(sorted(known))}" if known else ""
            raise UsageError(f"on={name}: no such profile. Make one with 'kerv bench target=TARGET'{others}")
        try:
            profiles.append(NamedProfile(name, read_profile(path)))
        except CheckpointError as error:
            raise UsageError(f"on={name}: {error}") from error
    return profiles

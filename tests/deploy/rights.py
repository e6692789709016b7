"""What the deployment tests need of the machine."""

import os

import pytest


def require_root() -> None:
    """Skip where a developer runs the tests without it."""
    if os.geteuid() != 0:
        pytest.skip("needs root, to make network namespaces or to start a container engine")

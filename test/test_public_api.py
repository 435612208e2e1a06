"""The public API: what the package offers from its root."""

from __future__ import annotations

import subprocess
import sys

import pytest

import magnetosuture_thread


def test_every_name_that_is_offered_can_be_imported():
    for name in magnetosuture_thread.__all__:
        assert getattr(magnetosuture_thread, name).__doc__
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = magnetosuture_thread.no_such_name


def test_nothing_is_imported_before_it_is_used():
    code = "import sys, magnetosuture_thread; print(sorted({'numpy', 'numba', 'osqp', 'rclpy'} & set(sys.modules)))"
    found = subprocess.run([sys.executable, "-c", code], check=True, timeout=300, capture_output=True, text=True)
    assert found.stdout.strip() == "[]"

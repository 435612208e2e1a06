"""Runs the command as a module."""

import sys

from magnetosuture_thread.cli.main import main

sys.exit(main())

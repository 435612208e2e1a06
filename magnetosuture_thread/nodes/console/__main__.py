"""Runs the node `console`."""

import sys

from magnetosuture_thread.nodes.console import main

sys.exit(main())

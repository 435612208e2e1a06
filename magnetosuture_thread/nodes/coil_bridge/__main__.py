"""Runs the node `coil_bridge`."""

import sys

from magnetosuture_thread.nodes.coil_bridge import main

sys.exit(main())

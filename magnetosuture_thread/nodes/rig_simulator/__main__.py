"""Runs the node `rig_simulator`."""

import sys

from magnetosuture_thread.nodes.rig_simulator import main

sys.exit(main())

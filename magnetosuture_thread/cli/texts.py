"""What each command says of itself under --help."""

from __future__ import annotations

DESCRIPTION = """\
Predicts where a suture thread goes behind a magnetically steered needle.

Research software, no medical device. Lengths are in metres and times in seconds throughout.
"""

RECORD = """\
Render a reference trajectory as the overhead camera would see it, and write a bag: JPEG frames,
camera_info, the needle velocity commands that the trajectory amounts to, and the truth. Everything in
the bag is simulated; its notes say so, and `replay` repeats it.
"""

REPLAY = """\
Play an mcap bag through the live graph: vision_tracker, thread_model and coil_bridge run as processes
of their own, on a ROS domain that nobody else uses, with simulated time on /clock and no hardware.

DIR, which must not exist, gets
  bag/           all outputs of the graph, an mcap bag
  summary.json   the figures of the table
  summary.png    a frame with the predicted thread over the seen one; error and margins over time
  logs/          what each node printed
"""

EVALUATE = """\
Score the thread model on reference trajectories: files DIR/*.npz with the needle's poses and the thread
that followed (arrays t, pose, X and meta, as for `record`). The model starts from the first thread, is
driven by the poses and nothing else, with each file's own thread and parameters, and is compared at every
sample. Errors are mean distances of the nodes in % of the thread's length.
"""

BENCH = """\
Time the thread model on this machine: one whole step (barriers, obstacles and solves) and the solve
alone, by number of segments, dimension, obstacles and solver, with the largest residual beside every
time. Single thread, wall clock; the machine's other work shows in the 99th percentile.

With --bridge, time the coil bridge instead: how long until the duties of two simulated RoboClaw boards, on
pseudo-terminals, are zero, after a commander fell silent and after kill -9 of commander, tracker and bridge;
how even its loop is; and what 10,000 hostile messages can do. Meanwhile all cores are kept busy. Takes nine
minutes.
"""

SIMULATE = """\
Run the whole graph without a robot: rig_simulator stands in for coils, dish, needle, thread and camera;
vision_tracker, thread_model and coil_bridge are the ones that run on a robot; path_follower asks for
needle velocities along the scenario's path. All are processes of their own, on a ROS domain that nobody
else uses. Everything is simulated, and the bag says so.

SCENARIO is a set-up with waypoints in its section path_follower. BAG, which must not exist, gets all that
was said, the truth included, and the nodes' logs; `replay` takes it. Ctrl-C ends the run, and what was
recorded stays. The first run on a machine compiles for a minute before it begins.
"""

TRACK = """\
Find needle and thread in camera frames, without a graph. FRAMES are pictures, a folder of them, or a bag.
Pictures are looked at one by one; a bag's frames are followed over time, as the node vision_tracker does.

--json writes a list with an entry for each frame: file (for a bag, topic and stamp), status (tracked, lost
or searching) and its reason, tail_m, tip_m and heading_rad (the tangent at the tail), curvature_per_m
(positive to the left), thread_m from the tail on, all in the dish frame, confidence from 0 to 1, stamp_s,
and time_s, the processor time to look at the frame, on one core, without reading and decoding it; all is
compiled before. What has no value is null.
"""

CALIBRATE_CAMERA = """\
Find where the dish is in the camera's image: its centre, the scale and, by markers, the rotation. FILE
gets a section vision_tracker of a ROS 2 parameter file.

Without --markers the dish's rim is used: a mean over all frames. With --markers, ArUco markers 4x4_50 lie
around the dish, their centres SPACING apart on a square around its centre: 0 at the top left, then
clockwise, all upright.
"""

COILS = """\
Press a switch of the coil bridge that runs on this ROS domain, and show its state.

  state        show it
  arm, disarm  let velocity commands pass from now on, or none
  stop         emergency stop, latched; finding the bridge takes this command seconds: a button calls
               the service coils/emergency_stop
  reset        forget an emergency stop or a fault, once the driver is ready; the bridge stays disarmed
  configure, activate, deactivate, cleanup
               the lifecycle's transitions

The same by any ROS 2 tool: services coils/arm (std_srvs/SetBool), coils/emergency_stop and coils/reset
(std_srvs/Trigger).
"""

CALIBRATE_COILS = """\
Fit the model of the coils to what a probe measured in the dish, and write a calibration, which the
parameter `calibration` of coil_bridge names. MEASUREMENTS is a CSV file with the header

  coil,current,x,y,bx,by

in A, m and T, in the dish frame: one coil on at a time, by its index or name, the probe all over the dish,
ten places or more for each coil. Some lines with a current of 0 tell the background of earth and probe
apart, and so do both directions of current.
"""

BEHAVIOUR = """\
Run the paper's two thread-behaviour tests in a closed loop around the simulated rig, a polyamide thread
of 19 mm and a silk thread of 150 mm in a larger dish, and compare the predicted thread with the truth
and with what the camera sees. DIR, which must not exist, gets a bag of each, behaviour.json and
behaviour.png. Everything is simulated. Takes two minutes.
"""

EXIT_CODES = "exit codes: 0 done, 1 the job failed, 2 wrong use"

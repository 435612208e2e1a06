"""The thread estimated: the predictor's program, corrected by what the camera measures."""

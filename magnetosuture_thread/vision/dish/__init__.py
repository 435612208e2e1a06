"""The dish in a camera frame."""

"""The thread estimator against ground truth."""

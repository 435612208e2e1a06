"""Benchmarks: measurements that are too long for the test suite. Run one by  python -m benchmarks NAME."""

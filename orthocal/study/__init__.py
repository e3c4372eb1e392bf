"""What if: comparisons and checks made with calibrations."""

"""The stability study: extreme inputs compared with float64 and exact arithmetic, to find where each starts to fail."""

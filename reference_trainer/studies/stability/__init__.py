"""The stability study: extreme cases against float64 and exact arithmetic, and where each starts to fail."""

"""Measures of a trained model, and the pictures and tables that show them."""

"""Evaluation: errors against ground truth, tables of them, and running many sequences."""

"""Methods of the comparison: each is trained on the same pages and judged by the same ones."""

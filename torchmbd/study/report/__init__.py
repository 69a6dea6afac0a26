"""What a user sees of a study: progress, tables, the answer, comparisons and the HTML report."""

"""What a run leaves to read: tables, pages, plots, comparisons and the causes of failures."""

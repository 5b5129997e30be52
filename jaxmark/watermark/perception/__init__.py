"""The visibility of marks: budgets, masking, visibility by frequency, and the capacity within them."""

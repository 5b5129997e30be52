"""What people see of a mark: budgets, masking, visibility by frequency, and what a mesh can carry within them."""

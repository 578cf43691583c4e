"""Events: what each sensor alone tells of a target that passes."""

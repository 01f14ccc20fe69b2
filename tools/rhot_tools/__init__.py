"""What a person does with a rig beside tracking: measuring it, choosing paints."""

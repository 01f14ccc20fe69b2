"""Who may do what on a secured bus: a rig's own authority, certificates, roles, and what each role is allowed."""

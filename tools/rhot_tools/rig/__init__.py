"""`rhot evaluate rig`: one's own rig as the 2018 thesis measured its own."""

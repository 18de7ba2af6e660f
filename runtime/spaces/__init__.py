"""Action spaces as mathematics on arrays: joints, poses, orientation formats, frames, binary grippers."""

"""The processes of a station. None of them imports another, except lockstep, which runs all of them."""

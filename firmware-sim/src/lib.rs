//! Placeholder of `gadm-sim`; replaced by its first commit.

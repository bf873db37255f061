//! Placeholder of `gadm-trainer`; replaced by its first commit.

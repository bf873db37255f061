//! Placeholder of `gadm-node`; replaced by its first commit.

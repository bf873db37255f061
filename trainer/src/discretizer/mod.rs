//! Learned action discretisations.

pub mod gadm;

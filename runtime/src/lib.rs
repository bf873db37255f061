//! `no_std` inference of one GADM policy.
#![no_std]
#![forbid(unsafe_code)]

pub mod space;

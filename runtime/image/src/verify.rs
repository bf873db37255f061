//! From the pieces of a container back to the policy in it.

use gadm_runtime::schema::MAGIC;

use crate::{ADDRESS_ALIGN, Contents, ERASED, ImageError, PolicyImage};

/// What a container is expected to hold.
#[derive(Clone, Copy, Debug, Default)]
pub struct Expected<'a> {
    /// Address of the policy.
    pub address: Option<u32>,
    /// Policy file to compare with; bytes behind the policy are not compared.
    pub policy: Option<&'a [u8]>,
}

/// A policy that was found, loaded, tested, and is as expected.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Found {
    /// Its address; counted from the start of the file where the container holds no addresses.
    pub address: u32,
    /// The policy.
    pub policy: PolicyImage,
    /// Bytes of the container that do not belong to it and are not erased flash.
    pub other_bytes: usize,
}

/// Finds the policy in `contents`, loads it, runs its self-test and compares it with what is expected.
///
/// # Errors
/// No policy, several of them without an expected address, one elsewhere, one that does not load or fails its
/// self-test, or another one than expected.
pub fn verify(contents: &Contents, expected: &Expected<'_>) -> Result<Found, ImageError> {
    let candidates = candidates(contents);
    let list = || candidates.iter().map(|(address, _)| format!("{address:#010x}")).collect::<Vec<_>>().join(", ");
    let total: usize = contents.segments.iter().map(|segment| segment.bytes.len()).sum();
    let (address, bytes) = match (expected.address, candidates.as_slice()) {
        (_, []) => {
            // The runtime's reason for what stands where the policy should: erased, text damage, another file.
            let only = match contents.segments.as_slice() {
                [segment] if expected.address.is_none_or(|address| address == segment.address) => Some(segment),
                _ => None,
            };
            return Err(match only.map(|segment| PolicyImage::check(&segment.bytes)) {
                Some(Err(reason)) => reason,
                _ => ImageError::NoPolicy { format: contents.format, bytes: total, segments: contents.segments.len() },
            });
        }
        (Some(wanted), _) => *candidates
            .iter()
            .find(|(address, _)| *address == wanted)
            .ok_or_else(|| ImageError::OtherAddress { expected: wanted, found: list() })?,
        (None, [one]) => *one,
        // Firmware holds the first bytes of a policy as a constant: only what loads counts.
        (None, several) => {
            match several.iter().filter(|(_, bytes)| PolicyImage::check(bytes).is_ok()).collect::<Vec<_>>()[..] {
                [one] => *one,
                _ => return Err(ImageError::ManyPolicies { addresses: list() }),
            }
        }
    };
    let policy = PolicyImage::check(bytes)?;
    if let Some(file) = expected.policy {
        let wanted = PolicyImage::check(file)?;
        let (found, wanted) = (policy.bytes(), wanted.bytes());
        if found != wanted {
            let offset = found.iter().zip(wanted).take_while(|(a, b)| a == b).count();
            return Err(ImageError::Different { offset, expected_len: wanted.len(), found_len: found.len() });
        }
    }
    let other = |bytes: &[u8]| bytes.iter().filter(|byte| **byte != ERASED).count();
    let everything: usize = contents.segments.iter().map(|segment| other(&segment.bytes)).sum();
    let other_bytes = everything - other(policy.bytes());
    Ok(Found { address, policy, other_bytes })
}

/// Where a policy's first bytes stand, at the alignment that a policy has.
fn candidates(contents: &Contents) -> Vec<(u32, &[u8])> {
    let mut found = Vec::new();
    for segment in &contents.segments {
        let mut at = (segment.address.wrapping_neg() % ADDRESS_ALIGN) as usize;
        while let Some(rest) = segment.bytes.get(at..) {
            if rest.is_empty() {
                break;
            }
            if rest.starts_with(&MAGIC) {
                found.push((segment.address + at as u32, rest));
            }
            at += ADDRESS_ALIGN as usize;
        }
    }
    found
}

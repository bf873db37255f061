//! How one value becomes an i16.

/// Number of i16 steps from the middle of a range to its end.
const FULL_SCALE: f32 = 32767.0;
/// The i16 that stands for an invalid value.
pub const INVALID_I16: i16 = i16::MIN;

/// How one value becomes an i16.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Scale {
    /// Over `mid ± half`.
    Range { mid: f32, half: f32 },
    /// As it is: types and switches.
    Integer,
}

impl Scale {
    pub(super) fn range(lo: f32, hi: f32) -> Option<Self> {
        let (mid, half) = (lo * 0.5 + hi * 0.5, hi * 0.5 - lo * 0.5);
        (mid.is_finite() && half.is_finite() && half > 0.0).then_some(Self::Range { mid, half })
    }

    pub(super) fn quantise(self, value: f32) -> i16 {
        if !value.is_finite() {
            return INVALID_I16;
        }
        round_i16(match self {
            Self::Range { mid, half } => (value - mid) / half * FULL_SCALE,
            Self::Integer => value,
        })
    }

    pub(super) fn value(self, q: i16) -> f32 {
        if q == INVALID_I16 {
            return f32::NAN;
        }
        match self {
            Self::Range { mid, half } => mid + f32::from(q) / FULL_SCALE * half,
            Self::Integer => f32::from(q),
        }
    }
}

/// Round to nearest, halves away from zero, saturated at ±32767. `core` has no `f32::round`.
#[expect(clippy::cast_possible_truncation, reason = "truncation is meant; |y| < 2^15")]
pub(super) fn round_i16(y: f32) -> i16 {
    let y = y.clamp(-FULL_SCALE, FULL_SCALE);
    let whole = y as i16;
    let rest = y - f32::from(whole);
    if rest >= 0.5 {
        whole.saturating_add(1)
    } else if rest <= -0.5 {
        whole.saturating_sub(1)
    } else {
        whole
    }
}

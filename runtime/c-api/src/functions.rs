//! The functions.

use core::ffi::c_char;

use gadm_runtime::{ActError, ActionHead, Policy, Scratch};

use crate::memory::{Extent, disjoint};
use crate::status::Status;
use crate::types::{
    ActionInfo, ActionKind, Decision, ErrorDetail, LoadedPolicy, MASK_WORDS, ObservationInfo, POLICY_WORDS, Spec,
    TextSlice,
};

/// First eight bytes of a loaded `LoadedPolicy`, chosen at random.
const LOADED: u64 = 0x9C3E_51D2_A7F0_846B;

// `LoadedPolicy::words` holds a `Policy` at an address that suits it.
const _: () = {
    assert!(size_of::<Policy<'static>>() <= POLICY_WORDS * size_of::<usize>());
    assert!(align_of::<Policy<'static>>() <= align_of::<LoadedPolicy>());
    assert!(core::mem::offset_of!(LoadedPolicy, words).is_multiple_of(align_of::<Policy<'static>>()));
};

/// Version of this interface: changes when a program that used it must be changed.
#[unsafe(no_mangle)]
pub extern "C" fn gadm_abi_version() -> u32 {
    1
}

/// What a status means and what to do, as English text; never null.
#[unsafe(no_mangle)]
pub extern "C" fn gadm_status_text(status: i32) -> *const c_char {
    let known = Status::ALL.into_iter().find(|known| *known as i32 == status);
    #[cfg(feature = "control")]
    #[allow(clippy::indexing_slicing, reason = "the deliberate panic")]
    let known = known.or(Some(Status::ALL[status as usize]));
    known.map_or(c"unknown status", Status::text).as_ptr()
}

/// Checks the policy at the start of `image` and keeps what is needed to run it in `policy`. `len` may be longer than the
/// policy, as a flash slot is. With any status but `GADM_STATUS_OK`, `policy` holds no policy.
///
/// `error` may be null. Not checked: that the image stays readable and unchanged as long as the policy is used.
///
/// # Safety
/// `image` points to `len` readable bytes that stay as they are while `policy` is used; `policy` and `error` (or null)
/// point to writable memory.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn gadm_load(
    policy: *mut LoadedPolicy,
    image: *const u8,
    len: usize,
    error: *mut ErrorDetail,
) -> Status {
    // SAFETY: what is asked of the caller.
    let done = unsafe { load(policy, image, len, error) };
    // SAFETY: as above.
    unsafe { report(done, policy, error) }
}

unsafe fn load(
    policy: *mut LoadedPolicy,
    image: *const u8,
    len: usize,
    error: *mut ErrorDetail,
) -> Result<(), ErrorDetail> {
    let place = Extent::one(policy)?;
    // SAFETY: checked for null and alignment; no reference to it exists. A refused call leaves no old policy behind.
    unsafe { (&raw mut (*place.pointer()).check).write(0) };
    if image.is_null() {
        return Err(Status::NullPointer.into());
    }
    let beyond = image.addr() % gadm_runtime::schema::IMAGE_ALIGN;
    if beyond != 0 {
        // Before the content is looked at: from another address it is not a policy's.
        return Err(ErrorDetail::misaligned(gadm_runtime::schema::IMAGE_ALIGN, beyond));
    }
    let image = Extent::new(image, len)?;
    disjoint(&[place.span(), optional(error)?], &[image.span()])?;
    // SAFETY: the caller keeps the image readable and unchanged as long as the policy is used, so it outlives every use
    // of the reference.
    let image: &'static [u8] = unsafe { image.as_slice() };
    let load = if cfg!(feature = "trust-exporter") { Policy::load_trusted } else { Policy::load };
    let loaded = load(image).map_err(ErrorDetail::load)?;
    // SAFETY: the assertions above give size and alignment; the memory is the caller's to write, and overlaps nothing.
    unsafe {
        (&raw mut (*place.pointer()).image).write(image.as_ptr());
        (&raw mut (*place.pointer()).image_len).write(loaded.header().total_len as usize);
        (&raw mut (*place.pointer()).words).cast::<Policy<'static>>().write(loaded);
        (&raw mut (*place.pointer()).check).write(LOADED);
    }
    Ok(())
}

/// Forgets a policy, so that the image may be changed; null is allowed.
///
/// # Safety
/// `policy` is null or points to writable memory.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn gadm_unload(policy: *mut LoadedPolicy) {
    if let Ok(place) = Extent::one(policy) {
        // SAFETY: checked for null and alignment; no reference to it exists.
        unsafe { (&raw mut (*place.pointer()).check).write(0) };
    }
}

/// What the policy is and needs.
///
/// # Safety
/// `policy` was given to `gadm_load`, `spec` points to writable memory.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn gadm_get_spec(policy: *const LoadedPolicy, spec: *mut Spec) -> Status {
    // SAFETY: what is asked of the caller.
    unsafe {
        answer(policy, spec, |policy| {
            let (header, own) = (policy.header(), policy.spec());
            Ok(Spec {
                interface_hash: header.interface_hash,
                image_len: header.total_len,
                policy_seq: header.policy_seq,
                obs_dim: own.obs_dim.into(),
                action_dim: own.action_dim.into(),
                num_latents: own.num_latents.into(),
                control_period_us: own.control_period_us,
                scratch_words: header.scratch_words,
                macs: own.macs,
            })
        })
    }
}

/// Scratch memory of a step in words of 32 bits; 0 when no policy is loaded.
///
/// # Safety
/// `policy` is null or was given to `gadm_load`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn gadm_scratch_words(policy: *const LoadedPolicy) -> usize {
    // SAFETY: what is asked of the caller.
    unsafe { loaded(policy) }.map_or(0, |policy| policy.spec().scratch_words)
}

/// One control step: `obs_len` values in the units and order of the interface, `action_len` or fewer values out.
/// With any status but `GADM_STATUS_OK`, `action` and `decision` are untouched. `decision` and `error` may be null.
///
/// Not checked: that the memory is as long as said, and that no other task uses it at the same time.
///
/// # Safety
/// `policy` was given to `gadm_load`; the arrays are as long as said; `scratch`, `action`, `decision` and `error` are
/// writable and used by nothing else during the call.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn gadm_act(
    policy: *const LoadedPolicy,
    obs: *const f32,
    obs_len: usize,
    scratch: *mut u32,
    scratch_words: usize,
    action: *mut f32,
    action_len: usize,
    decision: *mut Decision,
    error: *mut ErrorDetail,
) -> Status {
    let buffers = Buffers { obs, obs_len, scratch, scratch_words, action, action_len, decision, error };
    // SAFETY: what is asked of the caller.
    unsafe { buffers.step(policy, Policy::act) }
}

/// As `gadm_act`, with an observation that is already quantised by `q_offset`, `q_scale` and `q_max` of
/// `gadm_observation`; no floating-point arithmetic before the action.
///
/// # Safety
/// As `gadm_act`.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn gadm_act_q(
    policy: *const LoadedPolicy,
    obs: *const i16,
    obs_len: usize,
    scratch: *mut u32,
    scratch_words: usize,
    action: *mut f32,
    action_len: usize,
    decision: *mut Decision,
    error: *mut ErrorDetail,
) -> Status {
    let buffers = Buffers { obs, obs_len, scratch, scratch_words, action, action_len, decision, error };
    // SAFETY: what is asked of the caller.
    unsafe { buffers.step(policy, Policy::act_q) }
}

/// Runs the vectors of the policy: latent and every bit of the action must be as stored. Run it once after `gadm_load`; a
/// policy that fails must not be run. `error` may be null.
///
/// # Safety
/// `policy` was given to `gadm_load`; `scratch` and `error` are writable and used by nothing else during the call.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn gadm_self_test(
    policy: *const LoadedPolicy,
    scratch: *mut u32,
    scratch_words: usize,
    error: *mut ErrorDetail,
) -> Status {
    let run = || {
        // SAFETY: what is asked of the caller.
        let own = unsafe { loaded(policy) }?;
        let memory = Extent::new(scratch, scratch_words)?;
        // SAFETY: `loaded` found a policy there.
        let [state, image] = unsafe { kept(policy) }?;
        disjoint(&[memory.span(), optional(error)?], &[state, image])?;
        // SAFETY: checked above, and the caller lets nothing else use it.
        let memory = unsafe { memory.as_mut_slice() };
        own.self_test(&mut Scratch::new(memory)).map_err(ErrorDetail::self_test)
    };
    // SAFETY: what is asked of the caller.
    unsafe { report(run(), policy, error) }
}

/// Name, unit, range and quantiser of observation `index`.
///
/// # Safety
/// `policy` was given to `gadm_load`, `info` points to writable memory.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn gadm_observation(
    policy: *const LoadedPolicy,
    index: usize,
    info: *mut ObservationInfo,
) -> Status {
    let read = |policy: &Policy<'static>| {
        let signal = policy.observation_signals().nth(index).ok_or(Status::NoSuchIndex)?;
        let quantiser = policy.input_quantisers().nth(index).ok_or(Status::NoSuchIndex)?;
        Ok(ObservationInfo {
            name: text(signal.name),
            unit: text(signal.unit),
            lo: signal.lo,
            hi: signal.hi,
            q_offset: quantiser.offset,
            q_scale: quantiser.scale,
            q_max: quantiser.max,
        })
    };
    // SAFETY: what is asked of the caller.
    unsafe { answer(policy, info, read) }
}

/// Name, unit, kind, range and safe value of action slot `index`.
///
/// # Safety
/// `policy` was given to `gadm_load`, `info` points to writable memory.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn gadm_action(policy: *const LoadedPolicy, index: usize, info: *mut ActionInfo) -> Status {
    let read = |policy: &Policy<'static>| {
        let signal = policy.action_signals().nth(index).ok_or(Status::NoSuchIndex)?;
        let (kind, types, lo, hi) = match signal.head {
            ActionHead::Continuous { lo, hi } => (ActionKind::Continuous, 0, lo, hi),
            ActionHead::Discrete { n } => (ActionKind::Discrete, n.into(), 0.0, 0.0),
            ActionHead::Binary => (ActionKind::Binary, 0, 0.0, 0.0),
        };
        Ok(ActionInfo { name: text(signal.name), unit: text(signal.unit), kind, types, lo, hi, safe: signal.safe })
    };
    // SAFETY: what is asked of the caller.
    unsafe { answer(policy, info, read) }
}

/// The policy behind a pointer.
///
/// # Safety
/// `policy` is null or was given to `gadm_load`, and its image is as it was then.
unsafe fn loaded<'a>(policy: *const LoadedPolicy) -> Result<&'a Policy<'static>, Status> {
    let place = Extent::one(policy)?.pointer();
    // SAFETY: checked for null and alignment; any eight bytes are a number.
    if unsafe { (&raw const (*place).check).read() } != LOADED {
        return Err(Status::NotLoaded);
    }
    // SAFETY: `gadm_load` wrote the number after it had written a policy there.
    Ok(unsafe { &*(&raw const (*place).words).cast::<Policy<'static>>() })
}

/// The memory that a loaded policy needs unchanged: its state and its image.
///
/// # Safety
/// [`loaded`] found a policy there.
unsafe fn kept(policy: *const LoadedPolicy) -> Result<[(usize, usize); 2], Status> {
    let place = Extent::one(policy)?;
    // SAFETY: `gadm_load` wrote both before it marked the policy as loaded.
    let (image, len) =
        unsafe { ((&raw const (*place.pointer()).image).read(), (&raw const (*place.pointer()).image_len).read()) };
    Ok([place.span(), Extent::new(image, len)?.span()])
}

/// Writes what `read` makes of the policy to `out`.
///
/// # Safety
/// As [`loaded`]; `out` is null or points to writable memory.
unsafe fn answer<T>(
    policy: *const LoadedPolicy,
    out: *mut T,
    read: impl FnOnce(&Policy<'static>) -> Result<T, Status>,
) -> Status {
    let run = || {
        // SAFETY: what is asked of the caller.
        let own = unsafe { loaded(policy) }?;
        let place = Extent::one(out)?;
        // SAFETY: `loaded` found a policy there.
        let [state, image] = unsafe { kept(policy) }?;
        disjoint(&[place.span()], &[state, image])?;
        let value = read(own)?;
        // SAFETY: checked for null and alignment, and no reference to it exists.
        unsafe { place.pointer().write(value) };
        Ok(())
    };
    run().err().unwrap_or(Status::Ok)
}

/// The place of an optional record; an empty span for null.
fn optional<T>(place: *const T) -> Result<(usize, usize), Status> {
    if place.is_null() { Ok((0, 0)) } else { Ok(Extent::one(place)?.span()) }
}

/// The status of a call, written to `error` too where that is possible and spoils no loaded policy.
///
/// # Safety
/// `error` is null or points to writable memory; `policy` is as for [`loaded`].
unsafe fn report(done: Result<(), ErrorDetail>, policy: *const LoadedPolicy, error: *mut ErrorDetail) -> Status {
    let detail = done.err().unwrap_or_else(|| Status::Ok.into());
    if let Ok(place) = Extent::one(error) {
        let state = Extent::one(policy).map_or((0, 0), Extent::span);
        // SAFETY: what is asked of the caller; `kept` is called only for a loaded policy.
        let image = unsafe { loaded(policy).and_then(|_| kept(policy)) }.map_or((0, 0), |[_, image]| image);
        if disjoint(&[place.span()], &[state, image]).is_err() {
            return detail.status;
        }
        // SAFETY: checked for null and alignment; no reference to it exists any more.
        unsafe { place.pointer().write(detail) };
    }
    detail.status
}

/// Arguments of a step.
struct Buffers<T> {
    obs: *const T,
    obs_len: usize,
    scratch: *mut u32,
    scratch_words: usize,
    action: *mut f32,
    action_len: usize,
    decision: *mut Decision,
    error: *mut ErrorDetail,
}

type StepFn<T> = fn(&Policy<'static>, &[T], &mut Scratch<'_>, &mut [f32]) -> Result<gadm_runtime::Decision, ActError>;

impl<T> Buffers<T> {
    /// # Safety
    /// As `gadm_act`.
    unsafe fn step(self, policy: *const LoadedPolicy, act: StepFn<T>) -> Status {
        let error = self.error;
        // SAFETY: what is asked of the caller.
        let done = unsafe { self.run(policy, act) };
        // SAFETY: as above.
        unsafe { report(done, policy, error) }
    }

    /// # Safety
    /// As `gadm_act`.
    unsafe fn run(self, policy: *const LoadedPolicy, act: StepFn<T>) -> Result<(), ErrorDetail> {
        // SAFETY: what is asked of the caller.
        let own = unsafe { loaded(policy) }?;
        let obs = Extent::new(self.obs, self.obs_len)?;
        let scratch = Extent::new(self.scratch, self.scratch_words)?;
        let action = Extent::new(self.action, self.action_len)?;
        // SAFETY: `loaded` found a policy there.
        let [state, image] = unsafe { kept(policy) }?;
        let (decision, error) = (optional(self.decision)?, optional(self.error)?);
        disjoint(&[scratch.span(), action.span(), decision, error], &[state, image, obs.span()])?;
        // SAFETY: checked above, and the caller lets nothing else use the memory.
        let (obs, scratch, action) = unsafe { (obs.as_slice(), scratch.as_mut_slice(), action.as_mut_slice()) };
        let decided = act(own, obs, &mut Scratch::new(scratch), action).map_err(ErrorDetail::act)?;
        if !self.decision.is_null() {
            let out = Decision {
                latent: decided.latent,
                fallback: decided.fallback,
                clipped: decided.clipped,
                q: decided.q,
                allowed: mask(&decided.allowed, own.spec().num_latents),
            };
            // SAFETY: `optional` checked the alignment, and no reference to it exists.
            unsafe { self.decision.write(out) };
        }
        Ok(())
    }
}

fn mask(allowed: &gadm_runtime::LatentMask, latents: u16) -> [u32; MASK_WORDS] {
    let mut words = [0; MASK_WORDS];
    for latent in (0..latents).filter(|latent| allowed.contains(*latent)) {
        if let Some(word) = words.get_mut(usize::from(latent >> 5)) {
            *word |= 1u32 << (latent & 31);
        }
    }
    words
}

fn text(text: &'static str) -> TextSlice {
    TextSlice { data: text.as_ptr().cast(), len: text.len() }
}

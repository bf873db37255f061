//! Fixed policies, any observation, any scratch: an answer within bounds, the same whatever the memory held.
#![no_main]

use gadm_fuzz::{Source, policies};
use gadm_runtime::encode::AlignedImage;
use gadm_runtime::{ActError, ActionHead, Policy, Scratch};
use libfuzzer_sys::fuzz_target;
use std::sync::OnceLock;

static IMAGES: OnceLock<Vec<AlignedImage>> = OnceLock::new();

fuzz_target!(|data: &[u8]| {
    let images = IMAGES.get_or_init(policies);
    let mut source = Source(data);
    let policy = Policy::load(&images[source.between(0, images.len() - 1)]).expect("written a moment ago");
    let spec = policy.spec();
    let fill = u32::from(source.byte()) * 0x0101_0101;
    let mut memory = vec![fill; spec.scratch_words];
    let slots = usize::from(spec.action_dim);
    let (mut first, mut second) = (vec![0.0; slots], vec![0.0; slots]);
    let obs: Vec<f32> = (0..spec.obs_dim).map(|_| source.float()).collect();
    match policy.act(&obs, &mut Scratch::new(&mut memory), &mut first) {
        Ok(decision) => {
            assert!(obs.iter().all(|x| x.is_finite()));
            assert!(decision.latent < spec.num_latents && decision.allowed.contains(decision.latent));
            assert!(!decision.allowed.is_empty() && decision.allowed.len() <= usize::from(spec.num_latents));
            for (value, signal) in first.iter().zip(policy.action_signals()) {
                match signal.head {
                    ActionHead::Continuous { lo, hi } => assert!((lo..=hi).contains(value)),
                    ActionHead::Discrete { n } => assert!(*value >= 0.0 && *value < f32::from(n)),
                    ActionHead::Binary => assert!(*value == 0.0 || *value == 1.0),
                }
            }
            let mut zeros = vec![0; spec.scratch_words + 3];
            let again = policy.act(&obs, &mut Scratch::new(&mut zeros), &mut second).expect("as before");
            assert_eq!((decision, &first), (again, &second));
            let quantised: Vec<i16> =
                policy.input_quantisers().zip(&obs).map(|(quantiser, x)| quantiser.quantise(*x).0).collect();
            let int = policy.act_q(&quantised, &mut Scratch::new(&mut memory), &mut second).expect("as before");
            assert_eq!((decision.latent, decision.q, &first), (int.latent, int.q, &second));
        }
        Err(ActError::NonFinite { index }) => assert!(!obs[index].is_finite()),
        Err(error) => panic!("{error:?}"),
    }
    let raw: Vec<i16> = obs.iter().map(|x| x.to_bits() as i16).collect();
    policy.act_q(&raw, &mut Scratch::new(&mut memory), &mut second).expect("any integers will do");
});

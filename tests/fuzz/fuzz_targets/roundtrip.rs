//! Any model that the writer takes: written, read back and written again gives the same bytes.
#![no_main]

use gadm_fuzz::Source;
use gadm_runtime::Policy;
use gadm_runtime::encode::{
    AlignedImage, EncodeError, FileOptions, QuantiseOptions, QuantisedModel, quantise, write_float, write_int8,
};
use libfuzzer_sys::fuzz_target;

fuzz_target!(|data: &[u8]| {
    let mut source = Source(data);
    let rows = source.between(1, 3);
    let model = source.model();
    let obs: Vec<f32> = source.numbers(rows * model.obs_mean.len());
    let options = FileOptions { policy_seq: 3, trailer: vec![] };
    match quantise(&model, &obs, &QuantiseOptions::default()) {
        Ok(quantised) => {
            let bytes = write_int8(&quantised, &obs, &options).expect("a quantised model can be written");
            let image = AlignedImage::new(&bytes);
            let policy = Policy::load(&image).expect("a written file can be read");
            let again = write_int8(&QuantisedModel::read(&policy), &obs, &options).expect("and written again");
            assert_eq!(bytes, again);
        }
        Err(error) => assert!(matches!(error, EncodeError::Value { .. }), "{error}"),
    }
    match write_float(&model, &obs, &options) {
        // Sums of wild weights may depend on their order; the writer says so.
        Ok(_) | Err(EncodeError::Value { .. } | EncodeError::SelfTest(_)) => {}
        Err(error) => panic!("{error}"),
    }
});

use gadm_node::codec::Profile;
use gadm_node::protocol::{Function, MESSAGES, NodeId};
use gadm_runtime::Policy;
use gadm_runtime::encode::AlignedImage;

use super::*;

const POLICIES: [&str; 3] = ["hopper-v5", "inverted-pendulum-v5", "moving"];

fn image(name: &str) -> AlignedImage {
    let path = format!("{}/../models/{name}/policy.bin", env!("CARGO_MANIFEST_DIR"));
    AlignedImage::new(&std::fs::read(path).unwrap())
}

fn databases() -> Vec<Database> {
    let mut all = Vec::new();
    for name in POLICIES {
        let image = image(name);
        let policy = Policy::load(&image).unwrap();
        for profile in Profile::ALL {
            all.push(Database::new(&policy, profile, NodeId::new(7).unwrap()).unwrap());
        }
    }
    all
}

#[test]
fn no_two_signals_share_a_bit_and_all_lie_in_the_frame() {
    for db in databases() {
        for message in &db.messages {
            for (i, a) in message.signals.iter().enumerate() {
                assert!(a.start + a.bits <= 8 * message.len, "{} {}", message.name, a.name);
                for b in &message.signals[..i] {
                    let apart = a.start >= b.start + b.bits || b.start >= a.start + a.bits;
                    let other_page = matches!((a.mux, b.mux), (Mux::Page(x), Mux::Page(y)) if x != y);
                    assert!(apart || other_page, "{}: {} and {}", message.name, a.name, b.name);
                    assert_ne!(a.name, b.name, "{}", message.name);
                }
            }
        }
    }
}

#[test]
fn every_row_of_the_protocol_that_the_profile_uses_is_there() {
    for db in databases() {
        for row in MESSAGES {
            let found = db.messages.iter().any(|m| m.id >= row.base && m.id < row.base + row.count);
            let long_action = row.name == "ACT_PART";
            let in_act = row.function == Function::Decision && db.profile == Profile::FdF32;
            assert_eq!(found, !in_act && !long_action, "{} in {}", row.name, db.profile.name());
        }
    }
}

#[test]
fn a_frame_of_known_layout() {
    let image = image("hopper-v5");
    let db = Database::new(&Policy::load(&image).unwrap(), Profile::ClassicI16, NodeId::new(7).unwrap()).unwrap();
    let part = db.message(0x183).unwrap();
    assert_eq!((part.name.as_str(), part.len, part.fd, part.cycle_us), ("OBS_3", 8, false, Some(8000)));
    let names: Vec<_> = part.signals.iter().map(|s| (s.name.as_str(), s.start, s.bits)).collect();
    assert_eq!(names, [("seq", 0, 8), ("leg_rate", 8, 16), ("foot_rate", 24, 16), ("crc", 56, 8)]);
    let signal = &part.signals[1];
    assert_eq!((signal.limits, signal.offset, signal.unit.as_str()), (Some((-10.0, 10.0)), 0.0, "rad/s"));
    assert_eq!(signal.factor, 10.0 / 32767.0);
    assert_eq!(signal.values, [(-32768, "invalid".to_owned())]);
    assert_eq!(db.message(0x107).unwrap().name, "ACT");
    let names: Vec<_> = db.messages.iter().map(|m| m.name.as_str()).collect();
    assert!(names.contains(&"ESTOP_ALL") && names.contains(&"HEARTBEAT"), "{names:?}");
}

/// A parser that nobody here wrote reads the file and finds what was meant.
#[test]
fn can_dbc_reads_the_same_messages() {
    for db in databases() {
        let parsed = can_dbc::Dbc::try_from(db.text().as_str()).unwrap();
        assert_eq!(parsed.messages.len(), db.messages.len());
        for (want, got) in db.messages.iter().zip(&parsed.messages) {
            assert_eq!((want.name.as_str(), want.len as u64), (got.name.as_str(), got.size));
            assert_eq!(want.signals.len(), got.signals.len(), "{}", want.name);
            for (a, b) in want.signals.iter().zip(&got.signals) {
                assert_eq!((a.name.as_str(), a.start as u64, a.bits as u64), (b.name.as_str(), b.start_bit, b.size));
                assert_eq!((a.factor, a.offset, a.unit.as_str()), (b.factor, b.offset, b.unit.as_str()));
            }
        }
        let stops: Vec<_> =
            parsed.message_transmitters.iter().map(|t| (t.message_id.raw(), t.transmitter.join(" "))).collect();
        assert_eq!(stops, [0x10, 0x17].map(|id| (id, "HOST PLANT NODE".to_owned())), "of all nodes and of node 7");
        let floats = db.messages.iter().flat_map(|m| &m.signals).filter(|s| s.number == Number::Float).count();
        assert_eq!(parsed.signal_extended_value_type_list.len(), floats);
        let hash = format!("{:016x}", db.interface_hash);
        assert!(format!("{:?}", parsed.attribute_values_database).contains(&hash));
    }
}

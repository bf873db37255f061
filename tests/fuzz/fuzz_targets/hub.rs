//! Members that come, go and send any bytes, against a model of what a bus is: every frame reaches all others that are
//! open, once, in one order; no queue grows beyond its bound; nobody stops anybody.
#![no_main]

use gadm_fuzz::Source;
use gadm_node::Frame;
use libfuzzer_sys::fuzz_target;

// The file itself: as a dependency, the simulator would bring its hundred others into this instrumented build.
#[path = "../../../firmware-sim/src/bus/exchange.rs"]
#[expect(dead_code, reason = "the simulator uses the rest")]
mod exchange;

use exchange::{Exchange, Limits};

const LIMITS: Limits = Limits { members: 4, queue: 9 };

fuzz_target!(|data: &[u8]| {
    let mut source = Source(data);
    let mut hub = Exchange::new(LIMITS);
    // A member that only listens, and reads at once: it must hear everything, in order.
    let witness = hub.join(true).expect("the first has room");
    let mut members = Vec::new();
    let mut bytes = Vec::new();
    let mut time_us = 0;
    while !source.0.is_empty() {
        time_us += 1;
        let pick = usize::from(source.byte());
        let member = members.get(pick % members.len().max(1)).copied();
        match source.byte() % 8 {
            0 => {
                let came = hub.join(pick % 2 == 0);
                assert_eq!(came.is_some(), members.len() + 1 < LIMITS.members);
                members.extend(came);
            }
            1 => {
                if let Some(member) = member {
                    let counts = hub.leave(member).expect("it was there");
                    assert!(counts.received <= time_us * 64);
                    members.retain(|&m| m != member);
                    assert!(!hub.has(member) && hub.leave(member).is_none());
                }
            }
            2 => {
                if let Some(member) = member {
                    bytes.clear();
                    hub.take(member, &mut bytes, source.between(0, 300));
                    assert!(bytes.len() <= 300 + 143 && bytes.iter().all(u8::is_ascii));
                }
            }
            _ => {
                let Some(member) = member else { continue };
                let (chunk, rest) = source.0.split_at(source.0.len().min(pick % 40));
                source.0 = rest;
                for &byte in chunk {
                    let mut heard: Vec<Frame> = Vec::new();
                    hub.receive(member, &[byte], time_us, &mut |frame| heard.push(*frame));
                    assert!(heard.len() <= 1);
                    for frame in heard {
                        assert_eq!(hub.take_frame(witness), Some(frame));
                    }
                    assert_eq!(hub.take_frame(witness), None);
                }
            }
        }
        for &member in &members {
            assert!(hub.queued(member) <= LIMITS.queue);
        }
    }
});

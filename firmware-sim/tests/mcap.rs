//! A trace as MCAP, read back.
#![allow(clippy::unwrap_used, reason = "a test may fail loudly")]
#![cfg(feature = "mcap")]

mod support;

use std::collections::BTreeMap;
use std::io::Cursor;

use gadm_node::Profile;
use gadm_runtime::Policy;
use gadm_sim::bus::trace::Record;
use gadm_sim::decode::Decoder;
use gadm_sim::sil::Recorder;
use gadm_sim::{RunOptions, simulate};
use serde_json::Value;
use support::random_policy;

#[test]
fn every_signal_of_the_trace_is_in_the_file() {
    for profile in Profile::ALL {
        let env = gadm_envs::make("moving").unwrap();
        let image = random_policy(env.spec(), 11);
        let recorder = Recorder::default();
        let options = RunOptions { episodes: 2, seed: 4, profile, ..RunOptions::new("test") };
        let run = simulate(&options, &image, env, Some(Box::new(recorder.clone())), &mut |_| {}).unwrap();
        let interface = "vcan0".to_owned();
        let records: Vec<Record> = recorder
            .frames()
            .into_iter()
            .map(|(time_us, frame)| Record { time_us, interface: interface.clone(), frame: Some(frame) })
            .collect();
        let policy = Policy::load(&image).unwrap();
        let mut file = Cursor::new(Vec::new());
        let written = gadm_sim::mcap::export(&policy, &records, &mut file).unwrap();

        let bytes = file.into_inner();
        let mut topics: BTreeMap<String, Vec<(u64, Value)>> = BTreeMap::new();
        for message in mcap::MessageStream::new(&bytes).unwrap() {
            let message = message.unwrap();
            assert_eq!(message.channel.message_encoding, "json");
            let value: Value = serde_json::from_slice(&message.data).unwrap();
            let schema: Value = serde_json::from_slice(&message.channel.schema.as_ref().unwrap().data).unwrap();
            for key in value.as_object().unwrap().keys() {
                assert!(schema["properties"][key].is_object(), "{}: {key} is not in the schema", message.channel.topic);
            }
            topics.entry(message.channel.topic.clone()).or_default().push((message.log_time, value));
        }
        assert_eq!(topics.values().map(|v| v.len() as u64).sum::<u64>(), written.messages);
        assert_eq!(topics["/tick"].len() as u64, run.steps);
        assert_eq!(topics["/decision"].len() as u64, run.steps + 2, "the safe action after each episode too");

        // Every observation value, with the time of its frame.
        let decoder = Decoder::new(&policy, profile).unwrap();
        let observations = records.iter().filter_map(|r| {
            let decoded = decoder.decode(r.frame.as_ref().unwrap());
            (decoded.name == "OBS").then(|| (r.time_us * 1000, Value::Object(decoded.signals)))
        });
        assert_eq!(topics["/observation"], observations.collect::<Vec<_>>());

        let events: Vec<_> = topics["/events"].iter().map(|(_, e)| e["message"].as_str().unwrap()).collect();
        assert_eq!(events.len() as u64, written.events);
        for text in ["state READY, fault NONE", "state RUN, fault NONE", "command run, node 1", "safe actions begin"] {
            assert!(events.contains(&text), "{text}: {events:?}");
        }
    }
}

#[test]
fn what_cannot_be_read_is_an_event() {
    let env = gadm_envs::make("moving").unwrap();
    let image = random_policy(env.spec(), 11);
    let policy = Policy::load(&image).unwrap();
    let line = |text: &str| gadm_sim::bus::trace::parse_line(text).unwrap();
    let records = [
        line("(1.000000) can0 181#0102030405060708"),
        line("(1.100000) can0 20000040#0000000000000000"),
        line("(1.200000) can0 7FF#00"),
    ];
    let mut file = Cursor::new(Vec::new());
    let written = gadm_sim::mcap::export(&policy, &records, &mut file).unwrap();
    assert_eq!((written.messages, written.events), (3, 3));
}

//! Pictures of every environment: they show the state, have the size asked for, and other programs read them.
#![allow(clippy::unwrap_used, reason = "a test may fail loudly")]

use std::collections::HashSet;

use gadm_envs::render::{Film, Pace, Paint, Scene};
use gadm_envs::{ids, make};
use gadm_runtime::space::ActionHead;

/// An environment and its drawings at the start and after each of `steps` steps with all actuators driven up.
fn scenes(id: &str, steps: usize) -> Vec<Scene> {
    let mut env = make(id).unwrap();
    let mut obs = vec![0.0; env.spec().obs_dim()];
    env.reset(3, &mut obs);
    let action: Vec<f32> = env
        .spec()
        .actions
        .iter()
        .map(|a| match a.head {
            ActionHead::Continuous { hi, .. } => hi,
            ActionHead::Discrete { .. } => 0.0,
            // One switch alone: those of HardMove all together cancel out.
            ActionHead::Binary => f32::from(u8::from(a.name.ends_with("_0"))),
        })
        .collect();
    let mut all = vec![env.scene().unwrap_or_else(|| panic!("{id} does not draw itself"))];
    for _ in 0..steps {
        env.step(&action, &mut obs);
        all.push(env.scene().unwrap());
    }
    all
}

#[test]
fn every_environment_draws_its_state() {
    for id in ids() {
        let scenes = scenes(id, 3);
        let (first, last) = (&scenes[0], &scenes[3]);
        assert_ne!(first, last, "{id}: another state, the same drawing");
        assert_eq!(first, &self::scenes(id, 0)[0], "{id}: the same state, another drawing");
        let [before, after] = [first, last].map(|s| s.to_pixels(240));
        assert_eq!((before.width, before.height), (240, first.height_for(240)), "{id}");
        assert_eq!(before.rgb.len() as u32, 3 * before.width * before.height, "{id}");
        assert!(before.rgb != after.rgb, "{id}: the difference cannot be seen");
        let colours: HashSet<[u8; 3]> = before.rgb.as_chunks().0.iter().copied().collect();
        let thing = [Paint::Body, Paint::Limb, Paint::Accent].into_iter().any(|p| colours.contains(&p.rgb()));
        assert!(thing, "{id}: nothing but ground is in the picture");
        // For people: with this variable the drawings are left in its folder.
        if let Some(dir) = std::env::var_os("GADM_PICTURES") {
            std::fs::write(std::path::Path::new(&dir).join(format!("{id}.png")), last.to_png(320)).unwrap();
        }
        let svg = first.to_svg(240);
        assert!(svg.starts_with("<svg ") && svg.ends_with("</svg>\n") && !svg.contains("NaN"), "{id}");
        assert_ne!(svg, last.to_svg(240), "{id}");
    }
}

#[test]
fn a_restored_state_is_drawn_as_the_one_that_was_saved() {
    for id in ["sliding", "pendulum", "lunar-lander-continuous", "hopper-v5", "ant-v5"]
        .into_iter()
        .filter(|id| make(id).is_ok())
    {
        let mut env = make(id).unwrap();
        let mut obs = vec![0.0; env.spec().obs_dim()];
        env.reset(5, &mut obs);
        let action: Vec<f32> = env.spec().actions.iter().map(|a| a.safe).collect();
        for _ in 0..5 {
            env.step(&action, &mut obs);
        }
        let (state, scene) = (env.state(), env.scene());
        let mut other = make(id).unwrap();
        other.reset(6, &mut obs);
        other.restore(&state).unwrap();
        assert_eq!(other.scene(), scene, "{id}");
    }
}

#[test]
fn the_side_view_moves_with_the_hopper() {
    let Ok(mut env) = make("hopper-v5") else { return }; // a build without MuJoCo has no such body
    let mut obs = vec![0.0; env.spec().obs_dim()];
    env.reset(0, &mut obs);
    let mut state = env.state();
    let mut at = |x: f64| {
        state.reals[0] = x;
        env.restore(&state).unwrap();
        env.scene().unwrap()
    };
    let (start, far) = (at(0.0), at(2.0));
    let body =
        |s: &Scene| s.shapes.iter().filter(|s| format!("{s:?}").contains("paint: Body")).cloned().collect::<Vec<_>>();
    assert_eq!(format!("{:.6?}", body(&start)), format!("{:.6?}", body(&far)), "the camera follows the torso");
    assert_ne!(start.to_svg(300), far.to_svg(300), "the numbers on the floor do not");
}

#[test]
fn a_film_is_read_by_a_decoder_frame_by_frame() {
    for id in ["moving", "pendulum", "half-cheetah-v5"].into_iter().filter(|id| make(id).is_ok()) {
        let env = make(id).unwrap();
        let pace = Pace::of(env.spec());
        let every = pace.every as usize;
        let scenes = scenes(id, 6 * every);
        let mut film = Film::new(200, pace, 5);
        for scene in &scenes {
            film.step(scene);
        }
        assert_eq!((film.frames(), film.is_cut()), (5, true), "{id}");
        let file = film.finish();
        let mut options = gif::DecodeOptions::new();
        options.set_color_output(gif::ColorOutput::RGBA);
        let mut decoder = options.read_info(&file[..]).unwrap();
        let (width, height) = (usize::from(decoder.width()), usize::from(decoder.height()));
        assert_eq!((width as u32, height as u32), (200, scenes[0].height_for(200)), "{id}");
        assert_eq!(decoder.repeat(), gif::Repeat::Infinite);
        let mut canvas = vec![0_u8; 3 * width * height];
        let mut delays = Vec::new();
        while let Some(frame) = decoder.read_next_frame().unwrap() {
            delays.push(u32::from(frame.delay));
            for (i, rgba) in frame.buffer.as_chunks::<4>().0.iter().enumerate() {
                let x = usize::from(frame.left) + i % usize::from(frame.width);
                let y = usize::from(frame.top) + i / usize::from(frame.width);
                if rgba[3] > 0 {
                    canvas[3 * (y * width + x)..][..3].copy_from_slice(&rgba[..3]);
                }
            }
            // Only smooth edges may differ from the picture itself, and only a little.
            let wanted = scenes[(delays.len() - 1) * every].to_pixels(200).rgb;
            let error: u64 = canvas.iter().zip(&wanted).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
            assert!(error / (canvas.len() as u64) < 2, "{id}: frame {} differs", delays.len());
        }
        assert_eq!(delays, [pace.delay_cs, pace.delay_cs, pace.delay_cs, pace.delay_cs, 150], "{id}");
    }
}

#[test]
fn a_film_runs_in_real_time_or_says_how_slow_it_is() {
    let pace = |id: &str| Pace::of(make(id).unwrap().spec());
    assert_eq!((pace("pendulum").every, pace("pendulum").text().as_str()), (1, "in real time"));
    assert_eq!(pace("moving").text(), "16 times slower than real time");
    if make("hopper-v5").is_ok() {
        assert_eq!((pace("hopper-v5").every, pace("hopper-v5").delay_cs), (5, 4));
        assert_eq!(pace("hopper-v5").text(), "in real time");
    }
    assert!(Film::new(100, pace("moving"), 3).finish().is_empty());
}

#[test]
fn a_png_has_its_signature_and_size() {
    let png = scenes("toy-env", 0)[0].to_png(64);
    assert_eq!(&png[..8], b"\x89PNG\r\n\x1a\n");
    assert_eq!(png[16..24], [0, 0, 0, 64, 0, 0, 0, 64]);
}

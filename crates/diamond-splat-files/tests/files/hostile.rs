//! Broken files: never a panic, never more memory than stated, and texts that say what to do.
use crate::clouds::sample;
use diamond_splat_files::{SplatFormat, WriteOptions, limits, parse, read, to_bytes};
use proptest::prelude::*;
use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::path::PathBuf;

/// Counts the memory of the thread that asks it to.
struct Counting;

thread_local! {
    static NOW: Cell<isize> = const { Cell::new(0) };
    static PEAK: Cell<isize> = const { Cell::new(0) };
}

fn count(change: isize) {
    // At the end of a thread the counters may be gone.
    let _ = NOW.try_with(|now| {
        now.set(now.get() + change);
        let _ = PEAK.try_with(|peak| peak.set(peak.get().max(now.get())));
    });
}

unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count(layout.size() as isize);
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        count(-(layout.size() as isize));
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

/// The peak of memory during `f`, bytes above what was there.
fn peak<T>(f: impl FnOnce() -> T) -> (T, usize) {
    let before = NOW.get();
    PEAK.set(before);
    let out = f();
    (out, (PEAK.get() - before) as usize)
}

/// Constant costs: decoders' tables and windows, messages.
const OVERHEAD: usize = 4 << 20;

fn allowed(format: SplatFormat, file: usize) -> usize {
    OVERHEAD
        + match format {
            SplatFormat::Spz => limits::PACKED_FACTOR * limits::largest_body(file),
            SplatFormat::Glb | SplatFormat::Gltf => limits::GLTF_FACTOR * file,
            _ => limits::PLAIN_FACTOR * file,
        }
}

fn fixture(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../assets/fixtures/foreign-splats").join(name)
}

/// Whole files of every format.
fn valid() -> Vec<(SplatFormat, Vec<u8>)> {
    let mut out = Vec::new();
    for degree in [0, 3] {
        let cloud = sample(5, degree);
        for format in SplatFormat::ALL {
            for spz_version in [3, 4] {
                if format != SplatFormat::CompressedPly && (format == SplatFormat::Spz || spz_version == 3) {
                    out.push((format, to_bytes(&cloud, format, &WriteOptions { spz_version }).unwrap().0));
                }
            }
        }
    }
    let compressed = std::fs::read(fixture("splat-transform/degree3.compressed.ply")).unwrap();
    out.push((SplatFormat::CompressedPly, compressed));
    let foreign = std::fs::read(fixture("splat-transform/degree3_v4.spz")).unwrap();
    out.push((SplatFormat::Spz, foreign));
    out
}

/// Reads it as every format; only the outcome of its own is returned.
fn survive(bytes: &[u8], format: SplatFormat) -> Result<(), TestCaseError> {
    for other in SplatFormat::ALL {
        let (outcome, used) = peak(|| parse(bytes, other).map(|f| f.cloud.validate()));
        let limit = allowed(other, bytes.len());
        prop_assert!(used <= limit, "{other:?} of a {format:?} of {} bytes used {used}", bytes.len());
        if let Ok(valid) = outcome {
            prop_assert!(valid.is_ok(), "a cloud that is not valid: {valid:?}");
        }
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 256, ..ProptestConfig::default() })]

    #[test]
    fn changed_bytes(which in any::<prop::sample::Index>(), edits in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..6)) {
        let files = valid();
        let (format, mut bytes) = which.get(&files).clone();
        for (at, value) in edits {
            let i = at.index(bytes.len());
            bytes[i] = value;
        }
        survive(&bytes, format)?;
    }

    #[test]
    fn changed_headers(which in any::<prop::sample::Index>(), edits in prop::collection::vec((0usize..64, any::<u8>()), 1..4)) {
        let files = valid();
        let (format, mut bytes) = which.get(&files).clone();
        for (at, value) in edits {
            let i = at.min(bytes.len() - 1);
            bytes[i] = value;
        }
        survive(&bytes, format)?;
    }

    #[test]
    fn truncated(which in any::<prop::sample::Index>(), at in any::<prop::sample::Index>()) {
        let files = valid();
        let (format, bytes) = which.get(&files).clone();
        let bytes = &bytes[..at.index(bytes.len())];
        survive(bytes, format)?;
        // A whole number of rows is a shorter file; glTF and gzip may lose what is not needed.
        let shorter = format == SplatFormat::Splat && bytes.len().is_multiple_of(32);
        prop_assert!(shorter || parse(bytes, format).is_err() || format == SplatFormat::Spz);
    }

    #[test]
    fn changed_numbers_in_json(which in 0usize..400, value in prop::sample::select(vec!["-1", "1e400", "18446744073709551615", "4294967295", "null", "[]", "{}", "0.5", "\"x\"", "99999"])) {
        let bytes = to_bytes(&sample(3, 1), SplatFormat::Gltf, &WriteOptions::default()).unwrap().0;
        let text = String::from_utf8(bytes).unwrap();
        // The number after the `which`-th colon.
        let Some((at, _)) = text.match_indices(": ").nth(which) else { return Ok(()) };
        let end = text[at + 2..].find([',', '\n']).unwrap() + at + 2;
        let broken = format!("{}{value}{}", &text[..at + 2], &text[end..]);
        survive(broken.as_bytes(), SplatFormat::Gltf)?;
    }

    #[test]
    fn noise(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        survive(&bytes, SplatFormat::Splat)?;
    }

    #[test]
    fn damaged_body_of_a_gzip(edits in prop::collection::vec((0usize..200, any::<u8>()), 1..5), version in 0u8..5) {
        use std::io::{Read, Write};
        let file = to_bytes(&sample(4, 1), SplatFormat::Spz, &WriteOptions::default()).unwrap().0;
        let mut body = Vec::new();
        flate2::read::GzDecoder::new(file.as_slice()).read_to_end(&mut body).unwrap();
        for (at, value) in edits {
            let n = body.len();
            body[at % n] = value;
        }
        body[4] = version;
        let mut out = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
        out.write_all(&body).unwrap();
        survive(&out.finish().unwrap(), SplatFormat::Spz)?;
    }
}

#[test]
fn a_decompression_bomb_is_refused_before_it_unfolds() {
    use std::io::Write;
    let mut out = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::best());
    let count = 3_000_000u32;
    let mut head = 0x5053_474eu32.to_le_bytes().to_vec();
    head.extend(3u32.to_le_bytes());
    head.extend(count.to_le_bytes());
    head.extend([3, 12, 0, 0]);
    out.write_all(&head).unwrap();
    out.write_all(&vec![0; count as usize * 65]).unwrap();
    let bytes = out.finish().unwrap();
    let (result, used) = peak(|| parse(&bytes, SplatFormat::Spz));
    let text = result.unwrap_err().to_string();
    assert!(text.contains("made to exhaust memory"), "{text}");
    assert!(used < 1 << 20, "{used}");
}

#[test]
fn ten_broken_files_say_what_to_do() {
    let dir = std::env::temp_dir().join(format!("diamond-splat-files-hostile-{}", std::process::id()));
    std::fs::create_dir_all(&dir).unwrap();
    let cloud = sample(3, 1);
    let file = |format, version| to_bytes(&cloud, format, &WriteOptions { spz_version: version }).unwrap().0;
    let (ply, splat, spz, spz4) =
        (file(SplatFormat::Ply, 3), file(SplatFormat::Splat, 3), file(SplatFormat::Spz, 3), file(SplatFormat::Spz, 4));
    let (glb, gltf) = (file(SplatFormat::Glb, 3), file(SplatFormat::Gltf, 3));
    let text = |bytes: &[u8], from: &str, to: &str| {
        let text = String::from_utf8_lossy(bytes).into_owned();
        assert!(text.contains(from), "no {from}");
        text.replacen(from, to, 1).into_bytes()
    };
    let header = |from: &str, to: &str| {
        let end = ply.windows(11).position(|w| w == b"end_header\n").unwrap();
        [text(&ply[..end], from, to), ply[end..].to_vec()].concat()
    };
    let patched = |bytes: &[u8], at: usize, with: &[u8]| {
        let mut out = bytes.to_vec();
        out[at..at + with.len()].copy_from_slice(with);
        out
    };
    let cases: [(&str, Vec<u8>, &str); 14] = [
        ("truncated.ply", ply[..ply.len() - 7].to_vec(), "truncated"),
        ("points.ply", header("property float opacity", "property float quality"), "property opacity"),
        ("coefficients.ply", header("f_rest_8", "g_rest_8"), "0, 9, 24, 45 or 72"),
        ("rows.splat", splat[..70].to_vec(), "a multiple of 32 bytes"),
        ("nan.splat", patched(&splat, 36, &f32::NAN.to_le_bytes()), "position of splat 1"),
        ("truncated.spz", spz[..spz.len() / 2].to_vec(), "compressed stream"),
        ("picture.spz", b"\x89PNG\r\n\x1a\n0000".to_vec(), "wrong name"),
        ("version.spz", patched(&spz4, 4, &9u32.to_le_bytes()), "1 to 4"),
        ("count.spz", patched(&spz4, 8, &100_000_000u32.to_le_bytes()), "at most 16777216 bytes"),
        ("stream.spz", spz4[..spz4.len() - 3].to_vec(), "stream 5"),
        ("truncated.glb", glb[..glb.len() - 100].to_vec(), "length"),
        ("mesh.gltf", text(&gltf, "\"KHR_gaussian_splatting\": {", "\"KHR_other\": {"), "1 other primitives"),
        ("accessor.gltf", text(&gltf, "\"count\": 3", "\"count\": 300"), "rows within"),
        (
            "compressed.gltf",
            text(
                &gltf,
                "\"extensionsUsed\"",
                "\"extensionsRequired\": [\"EXT_meshopt_compression\"],\n  \"extensionsUsed\"",
            ),
            "without compression",
        ),
    ];
    for (name, bytes, part) in cases {
        let path = dir.join(name);
        std::fs::write(&path, bytes).unwrap();
        let message = read(&path).unwrap_err().to_string();
        assert!(message.contains(part) && message.contains(name), "{name}: {message}");
        println!("{}", message.replace(&format!("{}/", dir.display()), ""));
    }
    let message = read(dir.join("none.glb")).unwrap_err().to_string();
    assert!(message.contains("none.glb: could not read"), "{message}");
    std::fs::write(dir.join("model.obj"), "v 0 0 0").unwrap();
    println!("{}", read(dir.join("model.obj")).unwrap_err());
    std::fs::remove_dir_all(dir).unwrap();
}

//! PLY files: round trips in every format and type, files of other programs, and hostile ones.
use diamond_splat::{
    Gaussians, PlyColumn, PlyFormat, PlyTable, PointCloud, SH_DC, ScalarType, SplatError, SplatPly, parse_ply,
    ply_bytes, read_ply, write_ply,
};
use glam::{Quat, Vec3};
use proptest::prelude::*;
use std::path::PathBuf;

const FORMATS: [PlyFormat; 3] = [PlyFormat::Ascii, PlyFormat::BinaryLittleEndian, PlyFormat::BinaryBigEndian];

/// A directory of this test's own, removed when dropped.
struct Directory(PathBuf);

impl Directory {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("diamond-splat-ply-{}-{name}", std::process::id()));
        std::fs::create_dir_all(&path).unwrap();
        Self(path)
    }
}

impl Drop for Directory {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

fn column(len: usize) -> impl Strategy<Value = (ScalarType, Vec<f32>)> {
    prop::sample::select(ScalarType::ALL.to_vec()).prop_flat_map(move |scalar| {
        let value = match scalar.integer_range() {
            // Exactly representable in both: not every 32-bit integer is an f32.
            Some((low, high)) => {
                (low.max(-16777216.0) as i64..=high.min(16777216.0) as i64).prop_map(|v| v as f32).boxed()
            }
            None => prop_oneof![
                any::<f32>().prop_filter("finite", |v| v.is_finite()),
                Just(f32::MIN_POSITIVE),
                Just(1e-45),
                Just(f32::MAX),
                Just(-0.0)
            ]
            .boxed(),
        };
        (Just(scalar), prop::collection::vec(value, len))
    })
}

fn table() -> impl Strategy<Value = PlyTable> {
    (0usize..8, 1usize..6).prop_flat_map(|(len, columns)| {
        (prop::collection::vec(column(len), columns), prop::collection::vec("[ -~äß]{0,20}", 0..3)).prop_map(
            move |(columns, comments)| PlyTable {
                comments,
                columns: columns
                    .into_iter()
                    .enumerate()
                    .map(|(i, (scalar, values))| PlyColumn { name: format!("p{i}"), scalar, values })
                    .collect(),
                len,
            },
        )
    })
}

fn bits(table: &PlyTable) -> Vec<Vec<u32>> {
    table.columns.iter().map(|c| c.values.iter().map(|v| v.to_bits()).collect()).collect()
}

/// A valid file with every construct: comments, an element before and after, lists inside and outside of `vertex`.
fn elaborate(format: PlyFormat) -> Vec<u8> {
    let mut out = format!(
        "ply\nformat {} 1.0\ncomment made by hand\nobj_info nothing\nelement camera 2\nproperty short id\n\
         property list uchar double shape\nelement vertex 3\nproperty float x\nproperty list uint8 int32 tags\n\
         property double y\nproperty uchar red\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n",
        format.name()
    )
    .into_bytes();
    if format == PlyFormat::Ascii {
        out.extend_from_slice(b"7 2 0.5 1e3\n8 0\n\n1.5 2 9 -9 2.5 255\n-1 0 3e-2 0 \r\n0.1 1 4 5 6\n3 0 1 2\n");
        return out;
    }
    let big = format == PlyFormat::BinaryBigEndian;
    let mut put = |le: &[u8]| {
        let mut word = le.to_vec();
        if big {
            word.reverse();
        }
        out.extend(word);
    };
    put(&7i16.to_le_bytes());
    put(&[2]);
    put(&0.5f64.to_le_bytes());
    put(&1e3f64.to_le_bytes());
    put(&8i16.to_le_bytes());
    put(&[0]);
    for (x, tags, y, red) in [(1.5f32, vec![9i32, -9], 2.5f64, 255u8), (-1.0, vec![], 3e-2, 0), (0.1, vec![4], 5.0, 6)]
    {
        put(&x.to_le_bytes());
        put(&[tags.len() as u8]);
        tags.iter().for_each(|t| put(&t.to_le_bytes()));
        put(&y.to_le_bytes());
        put(&[red]);
    }
    put(&[3]);
    (0..3i32).for_each(|i| put(&i.to_le_bytes()));
    out
}

#[test]
fn other_elements_and_lists_are_walked_over() {
    for format in FORMATS {
        let table = parse_ply(&elaborate(format)).unwrap();
        assert_eq!(table.len, 3);
        assert_eq!(table.comments, ["made by hand"]);
        assert_eq!(table.columns.iter().map(|c| c.name.as_str()).collect::<Vec<_>>(), ["x", "y", "red"]);
        assert_eq!(table.column("x").unwrap(), [1.5, -1.0, 0.1]);
        assert_eq!(table.column("y").unwrap(), [2.5, 3e-2, 5.0]);
        assert_eq!(table.column("red").unwrap(), [255.0, 0.0, 6.0]);
        assert_eq!(table.column("tags"), None);
    }
}

#[test]
fn every_truncation_before_the_faces_is_an_error() {
    for format in FORMATS {
        let bytes = elaborate(format);
        // The vertices end where the one face begins; a last digit or line break may be missing from text.
        let needed = bytes.len() - if format == PlyFormat::Ascii { 9 } else { 13 };
        for length in 0..needed {
            assert!(parse_ply(&bytes[..length]).is_err(), "{format:?} cut to {length} bytes");
        }
        assert!(parse_ply(&bytes[..needed]).is_ok());
    }
}

fn text(body: &str) -> Result<PlyTable, SplatError> {
    parse_ply(body.as_bytes())
}

#[track_caller]
fn complains(result: Result<PlyTable, SplatError>, line: Option<usize>, words: &[&str]) {
    let error = result.expect_err("expected an error");
    let message = error.to_string();
    for word in words {
        assert!(message.contains(word), "`{message}` does not mention `{word}`");
    }
    let SplatError::File { line: found, .. } = error else { panic!("{error:?}") };
    assert_eq!(found, line, "{message}");
}

#[test]
fn bad_headers_are_refused_with_the_line() {
    complains(parse_ply(b""), Some(1), &["ply"]);
    complains(parse_ply(b"plyfoo\n"), Some(1), &["not a PLY file"]);
    complains(parse_ply(b"ply"), Some(1), &["first line"]);
    complains(text("ply\nformat ascii 1.0\nelement vertex 1\n"), Some(4), &["end_header", "truncated"]);
    complains(text("ply\nformat ascii 2.0\nend_header\n"), Some(2), &["1.0"]);
    complains(text("ply\nformat binary_middle_endian 1.0\nend_header\n"), Some(2), &["binary_middle_endian"]);
    complains(text("ply\nelement vertex 0\nend_header\n"), Some(3), &["format"]);
    complains(text("ply\nformat ascii 1.0\nelement face 0\nend_header\n"), Some(4), &["vertex"]);
    complains(text("ply\nformat ascii 1.0\nproperty float x\nend_header\n"), Some(3), &["before any element"]);
    complains(text("ply\nformat ascii 1.0\nelement vertex -1\nend_header\n"), Some(3), &["`-1`"]);
    complains(text("ply\nformat ascii 1.0\nelement vertex 99999999999999999999999\nend_header\n"), Some(3), &["count"]);
    complains(text("ply\nformat ascii 1.0\nelement vertex 0\nelement vertex 0\nend_header\n"), Some(4), &["second"]);
    complains(
        text("ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty int x\nend_header\n"),
        Some(5),
        &["second property `x`", "rename"],
    );
    complains(text("ply\nformat ascii 1.0\nelement vertex 0\nproperty half x\nend_header\n"), Some(4), &["`half`"]);
    complains(
        text("ply\nformat ascii 1.0\nelement vertex 0\nproperty list float int x\nend_header\n"),
        Some(4),
        &["integer"],
    );
    complains(text("ply\nformat ascii 1.0\nelephant\nend_header\n"), Some(3), &["`elephant`"]);
    complains(text("ply\nformat ascii 1.0\nelement vertex 5\nend_header\n"), Some(3), &["without any scalar"]);
}

#[test]
fn giant_counts_are_refused_before_anything_is_allocated() {
    for count in ["1000000000000", "18446744073709551615"] {
        for format in FORMATS {
            let file = format!(
                "ply\nformat {} 1.0\nelement vertex {count}\nproperty float x\nproperty double y\nend_header\n1 2\n",
                format.name()
            );
            let message = text(&file).unwrap_err().to_string();
            assert!(message.contains("truncated"), "{message}");
            // The same in an element that is skipped, with nothing in it but a list.
            let file = format!(
                "ply\nformat {} 1.0\nelement face {count}\nproperty list uint char x\nelement vertex 0\nend_header\n1 2\n",
                format.name()
            );
            assert!(text(&file).is_err());
        }
    }
    // A list that claims 2³² − 1 doubles.
    let mut bytes =
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty list uint double l\nproperty uchar x\nend_header\n"
            .to_vec();
    bytes.extend([255, 255, 255, 255, 0]);
    complains(parse_ply(&bytes), None, &["byte", "4294967295"]);
    // Negative list counts.
    let mut bytes =
        b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty list char double l\nproperty uchar x\nend_header\n"
            .to_vec();
    bytes.extend([255, 0]);
    complains(parse_ply(&bytes), None, &["-1 items"]);
    // An element without properties takes no space, however many there are.
    assert!(
        text("ply\nformat ascii 1.0\nelement nothing 18446744073709551615\nelement vertex 0\nend_header\n").is_ok()
    );
}

#[test]
fn bad_values_are_refused_with_line_or_byte() {
    let head = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty uchar red\nend_header\n";
    complains(text(&format!("{head}1.250 2\n3\n")), Some(8), &["vertex 1", "`red`", "each line"]);
    complains(text(&format!("{head}1 2 3\n4 5\n")), Some(7), &["`3`"]);
    complains(text(&format!("{head}1 256\n4 5\n")), Some(7), &["uchar", "`256`"]);
    complains(text(&format!("{head}1 2.5\n4 5\n")), Some(7), &["uchar", "`2.5`"]);
    complains(text(&format!("{head}one 2\n4 5\n")), Some(7), &["float", "`one`"]);
    complains(text(&format!("{head}1 2\n\n\nnan 5\n")), Some(10), &["vertex 1", "not finite"]);
    complains(text(&format!("{head}1e39 2\n4 5\n")), Some(7), &["not finite"]);
    complains(text(&format!("{head}1 2\n        \n   ")), Some(10), &["ends before `vertex` 1 of 2"]);
    complains(parse_ply(&[head.as_bytes(), b"1 \xff\xff\n1 2\n"].concat()), Some(7), &["no text"]);
    let mut bytes = ply_bytes(&one_column(ScalarType::F32, vec![1.0, 2.0]), PlyFormat::BinaryBigEndian).unwrap();
    let at = bytes.len() - 4;
    bytes[at..].copy_from_slice(&f32::INFINITY.to_be_bytes());
    complains(parse_ply(&bytes), None, &[&format!("byte {at}"), "`p`", "vertex 1", "inf"]);
}

fn one_column(scalar: ScalarType, values: Vec<f32>) -> PlyTable {
    let mut table = PlyTable::new(values.len());
    table.push("p", scalar, values);
    table
}

#[test]
fn tables_that_could_not_be_read_back_are_not_written() {
    let refused = |table: &PlyTable, word: &str| {
        for format in FORMATS {
            let message = ply_bytes(table, format).unwrap_err().to_string();
            assert!(message.contains(word), "{message}");
        }
    };
    refused(&one_column(ScalarType::F32, vec![f32::NAN]), "finite");
    refused(&one_column(ScalarType::U8, vec![1.5]), "from 0 to 255");
    refused(&one_column(ScalarType::U8, vec![-1.0]), "from 0 to 255");
    refused(&PlyTable::new(3), "at least one");
    let mut table = one_column(ScalarType::F32, vec![1.0]);
    table.push("p", ScalarType::F32, vec![1.0]);
    refused(&table, "a name of its own");
    table.columns[1].name = "a b".into();
    refused(&table, "without blanks");
    table.columns[1].name = "q".into();
    table.columns[1].values.push(2.0);
    refused(&table, "1 values");
    table.columns.pop();
    table.comments.push("two\nelement vertex 9".into());
    refused(&table, "one line");
}

#[test]
fn files_are_replaced_whole_and_leave_no_debris() {
    let directory = Directory::new("replace");
    let path = directory.0.join("a.ply");
    let first = one_column(ScalarType::F32, vec![1.0, 2.0]);
    let second = one_column(ScalarType::U16, vec![3.0]);
    write_ply(&path, &first).unwrap();
    assert_eq!(read_ply(&path).unwrap(), first);
    write_ply(&path, &second).unwrap();
    assert_eq!(read_ply(&path).unwrap(), second);
    let names: Vec<_> = std::fs::read_dir(&directory.0).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert_eq!(names, ["a.ply"]);
    // A table that cannot be written leaves the old file.
    let error = write_ply(&path, &one_column(ScalarType::F32, vec![f32::NAN])).unwrap_err();
    assert!(matches!(&error, SplatError::File { path: p, .. } if *p == path), "{error}");
    assert_eq!(read_ply(&path).unwrap(), second);
    // Errors name the file.
    let absent = directory.0.join("absent.ply");
    assert!(read_ply(&absent).unwrap_err().to_string().contains("absent.ply"));
    assert!(
        write_ply(directory.0.join("no/such/directory.ply"), &first).unwrap_err().to_string().contains("directory.ply")
    );
    assert!(write_ply("/", &first).is_err());
    std::fs::write(&absent, "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\nfoo\n").unwrap();
    complains(read_ply(&absent), Some(6), &["absent.ply:6", "`foo`"]);
}

/// A splat file as other programs write it: degree 3, zero normals, none of our attributes.
#[test]
fn splat_files_of_other_programs_are_read() {
    let mut table = PlyTable::new(2);
    let float = |table: &mut PlyTable, name: String, a: f32, b: f32| table.push(name, ScalarType::F32, vec![a, b]);
    for (i, name) in ["x", "y", "z", "nx", "ny", "nz"].into_iter().enumerate() {
        let value = if i < 3 { i as f32 } else { 0.0 };
        float(&mut table, name.into(), value, value + 10.0 * (i < 3) as i32 as f32);
    }
    for i in 0..3 {
        float(&mut table, format!("f_dc_{i}"), 0.1 * i as f32, -0.5);
    }
    for i in 0..45 {
        float(&mut table, format!("f_rest_{i}"), i as f32, -(i as f32));
    }
    float(&mut table, "opacity".into(), 0.0, 500.0);
    for i in 0..3 {
        float(&mut table, format!("scale_{i}"), -(i as f32), 300.0);
    }
    for i in 0..4 {
        float(&mut table, format!("rot_{i}"), [2.0, 0.0, 0.0, 0.0][i], i as f32);
    }
    for format in FORMATS {
        let splat = SplatPly::from_table(&parse_ply(&ply_bytes(&table, format).unwrap()).unwrap()).unwrap();
        assert_eq!(splat.len(), 2);
        assert_eq!(splat.means[1], Vec3::new(10.0, 11.0, 12.0));
        assert_eq!(splat.rotations[0], Quat::from_xyzw(0.0, 0.0, 0.0, 2.0));
        assert_eq!(splat.rotations[1], Quat::from_xyzw(1.0, 2.0, 3.0, 0.0));
        assert_eq!((splat.f_rest_count, splat.f_rest[44], splat.f_rest[45 + 3]), (45, 44.0, -3.0));
        assert_eq!((&splat.normals, &splat.base_color, &splat.visibility_sh), (&None, &None, &None));
        assert_eq!((&splat.roughness, &splat.metalness, &splat.subsurfaceness), (&None, &None, &None));
        let gaussians = splat.to_gaussians();
        assert_eq!(gaussians.validate(), Ok(()));
        assert_eq!((gaussians.opacities[0], gaussians.opacities[1]), (0.5, 1.0));
        assert!((gaussians.scales[0] - Vec3::new(1.0, (-1f32).exp(), (-2f32).exp())).length() < 1e-6);
    }
    // What is indispensable, and groups that are there in part.
    let without = |name: &str| {
        let mut table = table.clone();
        table.columns.retain(|c| c.name != name);
        SplatPly::from_table(&table).map(|_| PlyTable::new(0))
    };
    for name in ["x", "opacity", "scale_2", "rot_3", "nz", "f_dc_1", "f_rest_7"] {
        complains(without(name), None, &[name, "a splat file"]);
    }
    assert_eq!(
        SplatPly::from_table(&{
            let mut table = table.clone();
            table.columns.retain(|c| !c.name.starts_with("f_"));
            table
        })
        .unwrap()
        .f_dc,
        None
    );
}

#[test]
fn our_attributes_survive_a_file() {
    let directory = Directory::new("splat");
    let path = directory.0.join("scene.ply");
    let vectors = |k: f32| (0..5).map(|i| Vec3::new(i as f32 * k, 0.5 - i as f32, k)).collect::<Vec<_>>();
    let scalars = |k: f32| (0..5).map(|i| (i as f32 - k) * 1.1).collect::<Vec<_>>();
    let mut splat = SplatPly {
        comments: vec!["units: metres".into()],
        means: vectors(0.3),
        normals: Some(vectors(1.0)),
        f_dc: None,
        f_rest: (0..45).map(|i| i as f32).collect(),
        f_rest_count: 9,
        opacity_logits: scalars(2.0),
        log_scales: vectors(-2.0),
        rotations: (0..5).map(|i| Quat::from_xyzw(i as f32, 1.0, -2.0, 0.25)).collect(),
        base_color: Some(vectors(0.7)),
        roughness: Some(scalars(1.0)),
        metalness: Some(scalars(3.0)),
        subsurfaceness: Some(scalars(4.0)),
        visibility_sh: Some((0..5).map(|i| std::array::from_fn(|k| (i * 16 + k) as f32)).collect()),
    };
    splat.write(&path).unwrap();
    assert_eq!(SplatPly::read(&path).unwrap(), splat);
    splat.fill_display_color();
    let (shown, raw) = (splat.f_dc.as_ref().unwrap()[3].y * SH_DC + 0.5, splat.base_color.as_ref().unwrap()[3].y);
    assert!((shown * shown - 1.0 / (1.0 + (-raw).exp())).abs() < 1e-6);
    splat.write(&path).unwrap();
    assert_eq!(SplatPly::read(&path).unwrap(), splat);
    // Lists of different lengths are an error, not a panic.
    splat.roughness = Some(vec![0.0]);
    assert!(splat.write(&path).is_err());
    splat.roughness = None;
    splat.f_rest.pop();
    assert!(splat.write(&path).is_err());
}

#[test]
fn activations_are_inverted() {
    let mut gaussians = Gaussians::default();
    for (i, opacity) in [0.0, 1e-4, 0.3, 0.999, 1.0].into_iter().enumerate() {
        gaussians.push(Vec3::splat(i as f32), Vec3::new(1e-5, 0.3, 1e4), Quat::from_rotation_x(0.3), opacity);
    }
    gaussians.push(Vec3::ONE, Vec3::ZERO, Quat::IDENTITY, 0.5);
    let back = SplatPly::from_gaussians(&gaussians).to_gaussians();
    assert_eq!(back.validate(), Ok(()));
    for i in 0..gaussians.len() {
        assert!((back.opacities[i] - gaussians.opacities[i]).abs() < 2e-6);
        let error = (back.scales[i] - gaussians.scales[i]).abs() / gaussians.scales[i].max(Vec3::splat(1e-10));
        assert!(error.max_element() < 1e-5, "{error}");
    }
}

/// The point cloud of the example capture: a scanner's kind of file, with byte colours.
#[test]
fn the_example_capture_is_read() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../assets/captures/spot-small/points3d.ply");
    let cloud = PointCloud::read(path).unwrap();
    assert!(cloud.positions.len() > 100);
    let (normals, colors) = (cloud.normals.unwrap(), cloud.colors.unwrap());
    assert_eq!((normals.len(), colors.len()), (cloud.positions.len(), cloud.positions.len()));
    assert!(normals.iter().all(|n| (n.length() - 1.0).abs() < 1e-3));
    assert!(cloud.positions.iter().all(|p| p.length() < 10.0));
    assert!(colors.iter().any(|c| c.max_element() > 0.05));
}

#[test]
fn point_clouds_are_read_with_colours_of_any_type() {
    let body = |kind: &str, red: &str| {
        PointCloud::from_table(
            &text(&format!(
                "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty double y\nproperty int z\n\
                 property {kind} red\nproperty {kind} green\nproperty {kind} blue\nend_header\n1 2 3 {red} 0 0\n"
            ))
            .unwrap(),
        )
        .unwrap()
    };
    for (kind, red) in [("uchar", "51"), ("int", "51"), ("ushort", "13107"), ("float", "0.2")] {
        let cloud = body(kind, red);
        assert_eq!(cloud.positions, [Vec3::new(1.0, 2.0, 3.0)]);
        assert_eq!(cloud.normals, None);
        let colors = cloud.colors.as_ref().unwrap();
        assert!((colors[0] - Vec3::new(0.2, 0.0, 0.0)).length() < 1e-6);
        let back =
            PointCloud::from_table(&parse_ply(&ply_bytes(&cloud.to_table(), FORMATS[2]).unwrap()).unwrap()).unwrap();
        assert!((back.colors.unwrap()[0] - colors[0]).length() < 1e-6);
        assert_eq!(back.positions, cloud.positions);
    }
    complains(
        text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n")
            .and_then(|t| PointCloud::from_table(&t))
            .map(|_| PlyTable::new(0)),
        None,
        &["lacks y, z"],
    );
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 128, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn tables_survive_every_format(table in table()) {
        for format in FORMATS {
            let bytes = ply_bytes(&table, format).unwrap();
            let back = parse_ply(&bytes).unwrap();
            let integers_exact = table.columns.iter().zip(&back.columns).all(|(a, b)| a == b);
            prop_assert!(integers_exact && back.comments == table.comments && back.len == table.len);
            // Integers have no −0.
            let floats_only = |t: &PlyTable| {
                let mut t = t.clone();
                t.columns.retain(|c| c.scalar.integer_range().is_none());
                bits(&t)
            };
            prop_assert_eq!(floats_only(&back), floats_only(&table));
        }
    }

    #[test]
    fn random_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..200), with_magic in any::<bool>()) {
        let bytes = if with_magic { [b"ply\nformat ascii 1.0\n".as_slice(), &bytes].concat() } else { bytes };
        let _ = parse_ply(&bytes);
    }

    #[test]
    fn mutations_of_a_valid_file_never_panic(
        format in prop::sample::select(FORMATS.to_vec()),
        edits in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>(), 0..5u8), 1..6),
    ) {
        let mut bytes = elaborate(format);
        for (index, byte, kind) in edits {
            let at = index.index(bytes.len());
            match kind {
                0 => bytes[at] = byte,
                1 => bytes.insert(at, byte),
                2 => { bytes.remove(at); }
                3 => bytes[at] = b'0' + byte % 10,
                _ => bytes.truncate(at.max(1)),
            }
            if bytes.is_empty() { break; }
        }
        if let Ok(table) = parse_ply(&bytes) {
            prop_assert!(table.columns.iter().all(|c| c.values.len() == table.len));
            prop_assert!(table.columns.iter().flat_map(|c| &c.values).all(|v| v.is_finite()));
            let _ = PointCloud::from_table(&table);
        }
    }
}

//! A small tree that obeys every rule, and one broken on purpose for each rule: a rule never seen to fail is no rule.

use super::{Finding, Package, RULES, STALE, run_with};
use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

/// The planted tree's own table of floors.
const PLANTED: &[Package] = &[
    Package { name: "diamond-image", floor: 0, outside: Some(&[]), optional: &[], alone: Some(&[]) },
    Package { name: "diamond-testkit", floor: 0, outside: Some(&[]), optional: &[], alone: None },
    Package {
        name: "diamond-shading",
        floor: 1,
        outside: Some(&["glam"]),
        optional: &["rayon"],
        alone: Some(&["glam"]),
    },
    Package { name: "diamond-metrics", floor: 1, outside: Some(&[]), optional: &[], alone: Some(&[]) },
];

/// A folder that goes away with its owner.
struct Planted {
    root: PathBuf,
}

impl Drop for Planted {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.root);
    }
}

impl Planted {
    /// A tree with no violation.
    fn clean(name: &str) -> Planted {
        let root = std::env::temp_dir().join(format!("diamond-tidy-{}-{name}", std::process::id()));
        let _ = fs::remove_dir_all(&root);
        let planted = Planted { root };
        let tag = |name: &str| format!("{}{name}]", concat!("[", "eq:"));
        planted.write(
            "Cargo.toml",
            "[workspace]\nresolver = \"3\"\nmembers = [\"crates/*\"]\nexclude = [\"vendor\"]\n[workspace.lints.rust]\nmissing_docs = \"warn\"\n",
        );
        for (name, dependencies) in [
            ("diamond-image", "[dev-dependencies]\ndiamond-testkit = { path = \"../diamond-testkit\" }\n"),
            ("diamond-testkit", ""),
            (
                "diamond-shading",
                "[dependencies]\ndiamond-image = { path = \"../diamond-image\" }\nglam = { path = \"../../vendor/glam\" }\n",
            ),
            ("diamond-metrics", "[dependencies]\ndiamond-image = { path = \"../diamond-image\" }\n"),
        ] {
            planted.package("crates", name, dependencies);
        }
        for name in ["glam", "rayon", "wgpu"] {
            planted.package("vendor", name, "");
        }
        planted.write(
            "crates/diamond-shading/src/lib.rs",
            &format!(
                "//! Shading.\n\n/// A half. {tag}\npub fn half(x: f32) -> f32 {{\n    x / 2.0 // not .unwrap()\n}}\n\n#[cfg(test)]\nmod tests {{\n    // {tag}\n    #[test]\n    fn half_of_two() {{\n        Some(super::half(2.0)).unwrap();\n    }}\n}}\n",
                tag = tag("half")
            ),
        );
        planted.write(
            "docs/equations.md",
            &format!("# Equations\n\n| `{}` | x/2 | `diamond_shading::half` | `half_of_two` | – |\n", tag("half")),
        );
        planted.write("assets/fixtures/ggx/README.md", "Origin: closed forms.\n");
        planted
    }

    fn package(&self, folder: &str, name: &str, dependencies: &str) {
        let manifest = format!(
            "[package]\nname = \"{name}\"\nversion = \"0.1.0\"\nedition = \"2024\"\n\n[lints]\nworkspace = true\n\n{dependencies}"
        );
        // What lies in vendor/ stands for crates.io and obeys no rule of ours.
        let manifest = if folder == "vendor" { manifest.replace("[lints]\nworkspace = true\n", "") } else { manifest };
        self.write(&format!("{folder}/{name}/Cargo.toml"), &manifest);
        self.write(&format!("{folder}/{name}/src/lib.rs"), "//! A package.\n");
    }

    fn write(&self, path: &str, text: &str) {
        let path = self.root.join(path);
        fs::create_dir_all(path.parent().unwrap_or(Path::new("."))).expect("a folder in the temporary folder");
        fs::write(&path, text).expect("a file in the temporary folder");
    }

    fn append(&self, path: &str, text: &str) {
        let before = fs::read_to_string(self.root.join(path)).expect("a file of the planted tree");
        self.write(path, &(before + text));
    }

    fn replace(&self, path: &str, from: &str, to: &str) {
        let before = fs::read_to_string(self.root.join(path)).expect("a file of the planted tree");
        assert!(before.contains(from), "{path} has no {from:?}");
        self.write(path, &before.replace(from, to));
    }

    fn findings(&self) -> Vec<Finding> {
        run_with(&self.root, PLANTED).expect("a readable tree")
    }
}

const SHADING: &str = "crates/diamond-shading/src/lib.rs";
const SHADING_MANIFEST: &str = "crates/diamond-shading/Cargo.toml";

/// Rule, what is broken, and how.
type Case = (&'static str, &'static str, fn(&Planted));

const CASES: &[Case] = &[
    ("floors", "an arrow inside a floor", |t| {
        t.append(SHADING_MANIFEST, "diamond-metrics = { path = \"../diamond-metrics\" }\n")
    }),
    ("floors", "an arrow inside a floor, in tests", |t| {
        t.append(SHADING_MANIFEST, "[dev-dependencies]\ndiamond-metrics = { path = \"../diamond-metrics\" }\n")
    }),
    ("floors", "a package without a floor", |t| t.package("crates", "diamond-extra", "")),
    ("floors", "a row without a package", |t| {
        fs::remove_dir_all(t.root.join("crates/diamond-metrics")).expect("the planted package")
    }),
    ("outside", "an outside crate that is not listed", |t| {
        t.append("crates/diamond-testkit/Cargo.toml", "[dependencies]\nwgpu = { path = \"../../vendor/wgpu\" }\n")
    }),
    ("outside", "an outside crate behind a feature that is not listed", |t| {
        t.append(SHADING_MANIFEST, "wgpu = { path = \"../../vendor/wgpu\", optional = true }\n")
    }),
    ("import-alone", "something heavy two steps away", |t| {
        t.append("vendor/glam/Cargo.toml", "[dependencies]\nwgpu = { path = \"../wgpu\" }\n")
    }),
    ("testkit", "testkit outside tests", |t| {
        t.append(SHADING_MANIFEST, "diamond-testkit = { path = \"../diamond-testkit\" }\n")
    }),
    ("workspace-lints", "a package without lints", |t| t.replace(SHADING_MANIFEST, "[lints]\nworkspace = true\n", "")),
    ("workspace-lints", "documentation not asked for", |t| t.replace("Cargo.toml", "\"warn\"", "\"allow\"")),
    ("workspace-lints", "documentation waived", |t| {
        t.append(SHADING, "#[allow(missing_docs)]\npub const X: f32 = 1.0;\n")
    }),
    ("file-head", "no //!", |t| t.write("crates/diamond-image/src/pixel.rs", "/// A pixel.\npub struct Pixel;\n")),
    ("file-head", "an empty //!", |t| t.write("crates/diamond-image/src/pixel.rs", "//!\n//! A pixel.\n")),
    ("file-name", "a drawer", |t| t.write("crates/diamond-image/src/utils.rs", "//! Things.\n")),
    ("file-name", "a drawer of tests", |t| t.write("crates/diamond-image/tests/common/mod.rs", "//! Things.\n")),
    ("file-name", "an inline drawer", |t| t.append(SHADING, "pub mod helpers {}\n")),
    ("no-panic", "unwrap", |t| t.append(SHADING, "/// F.\npub fn f(x: Option<f32>) -> f32 {\n    x.unwrap()\n}\n")),
    ("no-panic", "expect over two lines", |t| {
        t.append(SHADING, "fn f(x: Option<f32>) -> f32 {\n    x\n        .expect(\"x\")\n}\n")
    }),
    ("no-panic", "todo", |t| t.append(SHADING, "fn f() {\n    todo!()\n}\n")),
    ("no-print", "printing", |t| t.append(SHADING, "fn f() {\n    eprintln!(\"x\");\n}\n")),
    ("no-print", "exiting", |t| t.append(SHADING, "fn f() {\n    std::process::exit(1);\n}\n")),
    ("same-bits", "an exponential of the platform", |t| {
        t.append(SHADING, "/// F.\npub fn f(x: f32) -> f32 {\n    x.exp()\n}\n")
    }),
    ("same-bits", "a logarithm by its path", |t| {
        t.append(SHADING, "fn f(x: Option<f32>) -> Option<f32> {\n    x.map(f32::ln)\n}\n")
    }),
    ("same-bits", "a rotation", |t| t.append(SHADING, "fn f() -> Quat {\n    Quat::from_rotation_z(1.0)\n}\n")),
    ("stands-alone", "a machine's folder", |t| {
        t.write("docs/testing.md", &format!("Look into {}scratch.\n", concat!("/t", "mp/")))
    }),
    ("stands-alone", "a neighbour folder in a script", |t| {
        t.write(".ci/run", &format!("ls {}\n", concat!("..", "/shared")))
    }),
    ("equations", "a tag without a row", |t| t.write("docs/equations.md", "# Equations\n")),
    ("equations", "a tag without a test", |t| t.replace(SHADING, concat!("    // [", "eq:half]"), "    //")),
    ("equations", "a row without code", |t| {
        let row = format!("| `{}third]` | x/3 | `diamond_shading::half` | `half_of_two` | – |\n", concat!("[", "eq:"));
        t.append("docs/equations.md", &row)
    }),
    ("equations", "a row that names no function", |t| t.replace("docs/equations.md", "::half", "::third")),
    ("equations", "a row that names no test", |t| t.replace("docs/equations.md", "half_of_two", "half_of_three")),
    ("equations", "a malformed tag", |t| {
        t.append(SHADING, &format!("/// {}Bad_Tag]\npub fn f() {{}}\n", concat!("[", "eq:")))
    }),
    ("fixture-readme", "numbers without an origin", |t| t.write("assets/fixtures/splat/a.csv", "1\n")),
    ("allow-reason", "a permission without a reason", |t| {
        t.append(SHADING, &format!("// {})\n", super::source::ALLOW))
    }),
    (STALE, "a permission that lifts nothing", |t| {
        t.append(SHADING, &format!("// {}it was needed once)\n", super::source::ALLOW))
    }),
    ("file-length", "a long file", |t| t.append(SHADING, &"// x\n".repeat(600))),
];

#[test]
fn a_clean_tree_has_no_findings() {
    assert_eq!(Planted::clean("clean").findings(), vec![]);
}

#[test]
fn each_violation_is_found_under_its_own_rule() {
    for (i, (rule, what, plant)) in CASES.iter().enumerate() {
        let planted = Planted::clean(&format!("case-{i}"));
        plant(&planted);
        let findings = planted.findings();
        assert!(findings.iter().any(|finding| finding.rule == *rule), "{rule}, {what}: not found in {findings:?}");
    }
}

#[test]
fn each_rule_has_a_violation_planted() {
    let planted: BTreeSet<&str> = CASES.iter().map(|case| case.0).collect();
    let rules: BTreeSet<&str> = RULES.iter().map(|rule| rule.name).chain([STALE]).collect();
    assert_eq!(planted, rules);
}

#[test]
fn a_permission_with_a_reason_lifts_its_line_and_no_other() {
    let planted = Planted::clean("allow");
    let allow = format!("// {}checked two lines above)", super::source::ALLOW);
    planted.append(SHADING, &format!("fn f(x: Option<f32>) -> f32 {{\n    x.unwrap() {allow}\n}}\n"));
    assert_eq!(planted.findings(), vec![]);
    planted.append(SHADING, "fn g(x: Option<f32>) -> f32 {\n    x.unwrap()\n}\n");
    assert_eq!(planted.findings().len(), 1);
}

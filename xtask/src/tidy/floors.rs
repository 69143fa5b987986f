//! The floors of the house: who may use whom, and what each package may bring in from outside.
//!
//! Direct dependencies, optional ones included, are read from the manifests (`cargo metadata`); what an importer of one
//! package really compiles is asked of `cargo tree`, which follows features as that importer would.

use super::Violations;
use super::tree::Tree;
use std::collections::BTreeSet;
use std::path::Path;
use std::process::Command;

/// One row of the table of packages.
#[derive(Debug)]
pub struct Package {
    /// Package name.
    pub name: &'static str,
    /// Floor; dependencies on our packages go to lower floors only.
    pub floor: u8,
    /// Outside crates that it may name as a dependency; `None` is anything.
    pub outside: Option<&'static [&'static str]>,
    /// Outside crates that it may name only as optional dependencies.
    pub optional: &'static [&'static str],
    /// Everything from outside that an importer with default features may end up compiling; `None` is anything.
    pub alone: Option<&'static [&'static str]>,
}

impl Package {
    /// The folder's name, which is the package's but for the cross-crate tests.
    pub fn folder(&self) -> &'static str {
        if self.name == "diamond-tests" { "tests" } else { self.name }
    }
}

/// Outside crates that any package may use in tests and benches.
const FOR_TESTS: &[&str] = &["proptest", "divan", "libtest-mimic"];

/// The testkit's name: the one package of ours that any other may use, in tests only.
const TESTKIT: &str = "diamond-testkit";

/// What `pulp`, and with it `diamond-simd`, compiles.
const SIMD: &[&str] = &[
    "pulp",
    "pulp-wasm-simd-flag",
    "autocfg",
    "bitflags",
    "bytemuck",
    "cfg-if",
    "libm",
    "num-complex",
    "num-traits",
    "paste",
    "raw-cpuid",
    "reborrow",
    "version_check",
];

/// [`SIMD`] and glam.
const SIMD_AND_GLAM: &[&str] = &[
    "glam",
    "pulp",
    "pulp-wasm-simd-flag",
    "autocfg",
    "bitflags",
    "bytemuck",
    "cfg-if",
    "libm",
    "num-complex",
    "num-traits",
    "paste",
    "raw-cpuid",
    "reborrow",
    "version_check",
];

const fn light(name: &'static str, floor: u8, outside: &'static [&'static str]) -> Package {
    Package { name, floor, outside: Some(outside), optional: &[], alone: Some(&["glam", "libm"]) }
}

const fn heavy(name: &'static str, floor: u8, outside: &'static [&'static str]) -> Package {
    Package { name, floor, outside: Some(outside), optional: &[], alone: None }
}

/// Every package of the workspace; the same table as in docs/architecture.md.
pub const PACKAGES: &[Package] = &[
    Package { name: "diamond-image", floor: 0, outside: Some(&["libm"]), optional: &[], alone: Some(&["libm"]) },
    light("diamond-camera", 0, &["glam", "libm"]),
    light("diamond-light", 0, &["glam", "libm"]),
    Package { name: "diamond-simd", floor: 0, outside: Some(&["pulp"]), optional: &[], alone: Some(SIMD) },
    heavy(TESTKIT, 0, &["proptest"]),
    heavy("diamond-splat", 1, &["glam", "rayon", "libm"]),
    Package {
        name: "diamond-shading",
        floor: 1,
        outside: Some(&["glam", "libm"]),
        optional: &["rayon"],
        alone: Some(SIMD_AND_GLAM),
    },
    Package { name: "diamond-metrics", floor: 1, outside: Some(&["libm"]), optional: &["rayon"], alone: Some(SIMD) },
    heavy("diamond-dataset", 1, &["glam", "serde", "serde_json", "image", "exr", "sha2", "libm"]),
    light("diamond-consistency", 2, &["glam", "libm"]),
    Package { name: "diamond-losses", floor: 2, outside: Some(&["libm"]), optional: &[], alone: Some(SIMD) },
    Package {
        name: "diamond-photometric",
        floor: 2,
        outside: Some(&["glam", "libm"]),
        optional: &["rayon"],
        alone: Some(&["glam", "libm"]),
    },
    heavy("diamond-pathtrace", 2, &["glam", "rayon", "obvhs", "rand_pcg", "tobj", "gltf", "base64"]),
    heavy(
        "diamond-diffusion",
        2,
        &["glam", "libm", "rayon", "candle-core", "gemm", "rand_chacha", "safetensors", "half", "serde", "serde_json"],
    ),
    heavy("diamond-splat-files", 2, &["glam", "serde", "serde_json", "base64", "flate2", "ruzstd", "libm"]),
    heavy("diamond-augment", 2, &["glam", "serde", "serde_json", "sha2", "safetensors", "half", "libm"]),
    heavy("diamond-lpips", 3, &["candle-core"]),
    heavy("diamond-synth", 3, &["glam", "rayon", "serde", "serde_json", "toml", "sha2", "safetensors", "half"]),
    heavy("diamond-medium", 3, &["glam", "rayon", "serde", "toml", "sha2", "libm"]),
    heavy("diamond-reconstruct", 4, &["glam", "rayon", "serde", "toml", "rand_chacha", "safetensors", "sha2", "libm"]),
    heavy("diamond-gpu", 5, &["glam", "wgpu", "naga", "bytemuck", "pollster", "libm", "rand_pcg"]),
    heavy(
        "diamond-sss",
        6,
        &[
            "glam",
            "rayon",
            "serde",
            "serde_json",
            "toml",
            "clap",
            "indicatif",
            "tracing",
            "tracing-subscriber",
            "image",
            "exr",
            "base64",
            "ctrlc",
            "signal-hook",
            "libm",
        ],
    ),
    Package { name: "xtask", floor: 7, outside: None, optional: &[], alone: None },
    Package { name: "diamond-tests", floor: 8, outside: None, optional: &[], alone: None },
];

/// A dependency as a manifest states it.
struct Dependency {
    name: String,
    dev: bool,
    optional: bool,
}

/// A member of the workspace.
struct Member {
    name: String,
    manifest: String,
    dependencies: Vec<Dependency>,
}

/// Asks cargo, offline, in the tree's root.
fn cargo(root: &Path, arguments: &[&str]) -> Result<String, String> {
    let program = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let output = Command::new(program)
        .args(arguments)
        .arg("--offline")
        .current_dir(root)
        .output()
        .map_err(|e| format!("cargo {}: {e}", arguments.join(" ")))?;
    if !output.status.success() {
        return Err(format!("cargo {}: {}", arguments.join(" "), String::from_utf8_lossy(&output.stderr).trim()));
    }
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}

fn members(tree: &Tree) -> Result<Vec<Member>, String> {
    let text = cargo(&tree.root, &["metadata", "--no-deps", "--format-version", "1"])?;
    let json: serde_json::Value = serde_json::from_str(&text).map_err(|e| format!("cargo metadata: {e}"))?;
    let root = tree.root.canonicalize().unwrap_or_else(|_| tree.root.clone());
    let string = |value: &serde_json::Value| value.as_str().unwrap_or_default().to_string();
    let mut found = Vec::new();
    for package in json["packages"].as_array().into_iter().flatten() {
        let manifest = string(&package["manifest_path"]);
        let relative =
            Path::new(&manifest).strip_prefix(&root).map_or(manifest.clone(), |p| p.to_string_lossy().into());
        let dependencies = package["dependencies"].as_array().into_iter().flatten().map(|dependency| Dependency {
            name: string(&dependency["name"]),
            dev: dependency["kind"] == "dev",
            optional: dependency["optional"] == true,
        });
        found.push(Member { name: string(&package["name"]), manifest: relative, dependencies: dependencies.collect() });
    }
    found.sort_by(|a, b| a.name.cmp(&b.name));
    Ok(found)
}

fn row<'a>(tree: &'a Tree, name: &str) -> Option<&'a Package> {
    tree.packages.iter().find(|package| package.name == name)
}

/// Every package is in the table, and its dependencies of ours lie on lower floors.
pub fn floors(tree: &Tree) -> Violations {
    let members = members(tree)?;
    let mut found = Vec::new();
    for member in &members {
        let Some(package) = row(tree, &member.name) else {
            let message = format!("{} has no floor: add it to the table in xtask/src/tidy/floors.rs", member.name);
            found.push((member.manifest.clone(), 0, message));
            continue;
        };
        for dependency in &member.dependencies {
            let Some(used) = row(tree, &dependency.name) else { continue };
            if used.floor >= package.floor && !(used.name == TESTKIT && dependency.dev) {
                let message = format!(
                    "{} (floor {}) uses {} (floor {}): only lower floors may be used",
                    package.name, package.floor, used.name, used.floor
                );
                found.push((member.manifest.clone(), 0, message));
            }
        }
    }
    for package in tree.packages {
        if !members.iter().any(|member| member.name == package.name) {
            let message = format!("the table of floors lists {}, which is no package here", package.name);
            found.push(("Cargo.toml".into(), 0, message));
        }
    }
    Ok(found)
}

/// Outside crates are those that the table allows, optional where it says optional.
pub fn outside(tree: &Tree) -> Violations {
    let mut found = Vec::new();
    let members = members(tree)?;
    let ours: BTreeSet<&str> = members.iter().map(|member| member.name.as_str()).collect();
    for member in &members {
        let Some(package) = row(tree, &member.name) else { continue };
        let Some(allowed) = package.outside else { continue };
        for dependency in member.dependencies.iter().filter(|dependency| !ours.contains(dependency.name.as_str())) {
            let name = dependency.name.as_str();
            let listed = allowed.contains(&name);
            let optionally = package.optional.contains(&name);
            let message = match (dependency.dev, dependency.optional) {
                (true, _) if listed || optionally || FOR_TESTS.contains(&name) => continue,
                (false, _) if listed => continue,
                (false, true) if optionally => continue,
                (false, false) if optionally => format!("{name} must stay optional in {}", package.name),
                _ => format!(
                    "{} may not use {name} (allowed: {}); if it must, change the table with a decision record",
                    package.name,
                    if allowed.is_empty() { "nothing".into() } else { allowed.join(", ") }
                ),
            };
            found.push((member.manifest.clone(), 0, message));
        }
    }
    Ok(found)
}

/// What an importer of one light package compiles, through everything that it uses.
pub fn import_alone(tree: &Tree) -> Violations {
    let mut found = Vec::new();
    let members = members(tree)?;
    let ours: BTreeSet<&str> = members.iter().map(|member| member.name.as_str()).collect();
    for member in &members {
        let Some(allowed) = row(tree, &member.name).and_then(|package| package.alone) else { continue };
        let arguments = ["tree", "-p", &member.name, "-e", "normal,build", "--prefix", "none", "--format", "{p}"];
        let text = cargo(&tree.root, &arguments)?;
        let compiled: BTreeSet<&str> = text.lines().filter_map(|line| line.split_whitespace().next()).collect();
        if !compiled.contains(member.name.as_str()) {
            return Err(format!("cargo tree -p {} answered without naming it", member.name));
        }
        for name in compiled.iter().filter(|name| !ours.contains(**name) && !allowed.contains(name)) {
            let message = format!("importing {} alone compiles {name}; ask `cargo tree -i {name}` why", member.name);
            found.push((member.manifest.clone(), 0, message));
        }
    }
    Ok(found)
}

/// The testkit uses none of our packages, and is nowhere a dependency outside tests.
pub fn testkit(tree: &Tree) -> Violations {
    let mut found = Vec::new();
    for member in members(tree)? {
        for dependency in &member.dependencies {
            if member.name == TESTKIT && row(tree, &dependency.name).is_some() {
                found.push((member.manifest.clone(), 0, format!("{TESTKIT} uses {}, one of ours", dependency.name)));
            }
            if dependency.name == TESTKIT && !dependency.dev {
                let message = format!("{} uses {TESTKIT} outside tests: make it a dev-dependency", member.name);
                found.push((member.manifest.clone(), 0, message));
            }
        }
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_has_each_package_once_and_in_the_order_of_floors() {
        let names: BTreeSet<_> = PACKAGES.iter().map(|package| package.name).collect();
        assert_eq!(names.len(), PACKAGES.len());
        assert!(PACKAGES.is_sorted_by_key(|package| package.floor));
    }

    #[test]
    fn the_table_in_the_docs_says_the_same() {
        let path = super::super::workspace_root().join("docs/architecture.md");
        let text = std::fs::read_to_string(path).expect("docs/architecture.md");
        for package in PACKAGES {
            let row = format!("| {} | `{}`", package.floor, package.folder());
            let line = text.lines().find(|line| line.starts_with(&row));
            let line = line.unwrap_or_else(|| panic!("docs/architecture.md has no row `{row}`"));
            for name in package.outside.unwrap_or_default().iter().chain(package.optional) {
                assert!(line.contains(name), "docs/architecture.md: the row of {} does not name {name}", package.name);
            }
        }
    }
}

//! `cargo xtask`: oracle checks, house rules, fixtures, and all tests.

use clap::{Parser, Subcommand};
use std::path::PathBuf;
use std::process::ExitCode;
use xtask::oracle::{self, OracleKind};
use xtask::{captures, eval, fixtures, suite, tidy, tune};

/// The benchmarks that exist: targets of this package, compiled with optimisation.
const BENCHES: [&str; 3] = ["splat", "transport", "prior"];

const EXAMPLES: &str = "\
Examples:
  cargo xtask test                                  everything that must pass before a commit
  cargo xtask oracle ggx assets/fixtures/ggx        our microfacet terms against a table
  cargo xtask oracle splat scenes/dense_1000.npz    one splat scene
  cargo xtask bench splat                           time and error of the rasteriser
  cargo xtask bench transport -- --mitsuba python3  time and error of the path tracer, beside Mitsuba
  cargo xtask bench prior                           levels of the physical prior against the path tracer
  cargo xtask bench gpu                             time of every stage on a GPU, of a step, of many lights
  cargo xtask eval out/grid.toml --print            the commands of a grid of reconstructions that are not done
  cargo xtask tune out/tune.toml                    search settings on training images that are held out
  cargo xtask tidy --rules                          the house rules and their reasons
  cargo xtask fixtures --update                     accept the reference files as they are now
  cargo xtask fixtures --recipe                     render the small captures again and compare their bytes
  cargo xtask fixtures --recipe candle-small --update

Exit codes: 0 all is well, 1 a check failed, 2 wrong usage or unreadable input.";

/// The workspace's own tools.
#[derive(Parser)]
#[command(name = "cargo xtask", bin_name = "cargo xtask", after_help = EXAMPLES)]
struct Arguments {
    #[command(subcommand)]
    tool: Tool,
}

#[derive(Subcommand)]
enum Tool {
    /// Compare our implementation with reference values; prints the worst error of each column.
    Oracle {
        /// Which family of references.
        kind: OracleKind,
        /// A file or folder of the form of assets/fixtures/{ggx,splat,metrics} or of those in
        /// assets/fixtures/transport (analytic, mitsuba).
        path: PathBuf,
    },
    /// Check the house rules: floors, outside crates, file heads, equation tags, and more.
    Tidy {
        /// Print the rules with their reasons instead.
        #[arg(long)]
        rules: bool,
    },
    /// Run every test of the workspace, then the house rules.
    Test {
        /// The long tests too.
        #[arg(long)]
        full: bool,
    },
    /// Measure run time and error: `cargo xtask bench splat`, `cargo xtask bench transport`, `cargo xtask bench prior`.
    Bench {
        /// What to measure.
        #[arg(value_parser = BENCHES)]
        name: String,
        /// Passed on; `cargo xtask bench splat -- --help` lists what there is.
        #[arg(last = true)]
        rest: Vec<String>,
    },
    /// Reconstruct methods × regimes × objects × seeds of a TOML file and write tables; done runs are kept.
    Eval {
        /// The file; see xtask/src/eval.rs.
        file: PathBuf,
        /// The program that is run.
        #[arg(long, default_value = "target/release/diamond")]
        program: PathBuf,
        /// Print the commands of the runs that are not done instead.
        #[arg(long)]
        print: bool,
        /// Run every Nth run only, beginning with I: I/N.
        #[arg(long, default_value = "0/1")]
        shard: eval::Shard,
        /// What the program was built from, for the records; the workspace's revision unless told otherwise.
        #[arg(long)]
        revision: Option<String>,
    },
    /// Search settings of a TOML file on training images that are held out, and draw the trials; done trials are kept.
    Tune {
        /// The file; see xtask/src/tune.rs.
        file: PathBuf,
        /// The program that is run.
        #[arg(long, default_value = "target/release/diamond")]
        program: PathBuf,
        /// What the program was built from, for the records; the workspace's revision unless told otherwise.
        #[arg(long)]
        revision: Option<String>,
    },
    /// Compare reference files and captures with their manifest of hashes, or rendered captures with new ones.
    Fixtures {
        /// Compare (the default).
        #[arg(long, conflicts_with = "update")]
        check: bool,
        /// Rewrite the manifest from the files as they are.
        #[arg(long)]
        update: bool,
        /// Render captures of assets/captures/captures.toml again and compare bytes (with --update: replace them); all of them
        /// without names.
        #[arg(long, value_name = "NAME", num_args = 0..)]
        recipe: Option<Vec<String>>,
    },
}

fn main() -> ExitCode {
    match run(Arguments::parse().tool) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(1),
        Err(message) => {
            eprintln!("xtask: {message}");
            ExitCode::from(2)
        }
    }
}

/// Whether what was checked is well.
fn run(tool: Tool) -> Result<bool, String> {
    let root = tidy::workspace_root();
    match tool {
        Tool::Oracle { kind, path } => {
            let report = oracle::run(kind, &path)?;
            println!("{report}");
            Ok(report.passed())
        }
        Tool::Tidy { rules: true } => {
            for rule in tidy::RULES {
                println!("{:<16} {}", rule.name, rule.reason);
            }
            Ok(true)
        }
        Tool::Tidy { rules: false } => {
            let findings = tidy::run(root)?;
            findings.iter().for_each(|finding| println!("{finding}"));
            let errors = findings.iter().filter(|finding| !finding.warning).count();
            println!("tidy: {} rules, {errors} errors, {} hints", tidy::RULES.len(), findings.len() - errors);
            Ok(errors == 0)
        }
        Tool::Test { full } => suite::run(root, full),
        Tool::Bench { name, rest } => {
            let arguments = ["bench", "--quiet", "--package", "xtask", "--bench", &name, "--"];
            suite::cargo(root, &arguments.into_iter().chain(rest.iter().map(String::as_str)).collect::<Vec<_>>())
        }
        Tool::Eval { file, program, print, shard, revision } => {
            eval::run(root, &file, &eval::How { program, print, shard, revision })
        }
        Tool::Tune { file, program, revision } => tune::run(root, &file, &program, revision),
        Tool::Fixtures { update, recipe: Some(names), .. } => {
            let mut same = true;
            for capture in captures::chosen(root, &names)? {
                if update {
                    println!("{}: {} files", capture.name, capture.update(root)?);
                    continue;
                }
                let (count, differences) = capture.check(root)?;
                differences.iter().for_each(|difference| println!("{difference}"));
                println!("{}: {count} files rendered again, {} differences", capture.name, differences.len());
                same &= differences.is_empty();
            }
            if update {
                println!("{}: {} files", fixtures::MANIFEST, fixtures::update(root)?);
            }
            Ok(same)
        }
        Tool::Fixtures { update: true, .. } => {
            let count = fixtures::update(root)?;
            println!("{}: {count} files", fixtures::MANIFEST);
            Ok(true)
        }
        Tool::Fixtures { update: false, .. } => {
            let (count, differences) = fixtures::check(root)?;
            differences.iter().for_each(|difference| println!("{difference}"));
            println!("{}: {count} files, {} differences", fixtures::MANIFEST, differences.len());
            Ok(differences.is_empty())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_command_line_is_well_formed() {
        Arguments::command().debug_assert();
    }

    #[test]
    fn a_missing_reference_is_an_error_and_not_a_pass() {
        let tool = Tool::Oracle { kind: OracleKind::Ggx, path: "no/such/table.csv".into() };
        assert!(run(tool).is_err());
    }
}

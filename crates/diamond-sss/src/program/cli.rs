//! The words of the command line.
use clap::{Args, Parser, Subcommand};
use diamond_dataset::{Regime, Selection};
use diamond_gpu::DeviceChoice;
use diamond_reconstruct::{ByteSize, InstructionChoice};
use diamond_splat_files::{SplatFormat, WriteOptions};
use diamond_sss::ExportOptions;
use std::path::PathBuf;

/// Reconstructs translucent objects from photographs under one light at a time, and shows them under any light.
#[derive(Debug, Parser)]
#[command(
    name = "diamond",
    version,
    after_help = "Exit codes: 0 done, 1 the run failed, 2 usage, 3 bad input (capture, \
configuration, model files), 130 interrupted.\nSet DIAMOND_LOG=debug for more messages."
)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// What to do.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Make a relightable model from a capture: model, figures, report
    Reconstruct(ReconstructArguments),
    /// Say what a reconstruction would compute, what it would leave out and why, what it would need; computes nothing
    #[command(after_help = "Examples:
  diamond plan capture
  diamond plan capture --preset paper loss.mask=0 shading.metal=no
  diamond plan capture --json")]
    Plan {
        /// The capture
        capture: PathBuf,
        /// resolved, sss-3dgs, paper, or a TOML file
        #[arg(long, default_value = "resolved")]
        preset: String,
        /// Settings to change, such as loss.mask=0
        #[arg(value_name = "KEY=VALUE")]
        settings: Vec<String>,
        /// Training views: a count, or indices such as 0,5,7 or 0-7
        #[arg(long, default_value = "all")]
        views: Selection,
        /// Training lights: a count, or indices such as 0,5,7 or 0-7
        #[arg(long, default_value = "all")]
        lights: Selection,
        /// What the process may take in memory: 512MiB, 2GiB, bytes [default: the configuration, else no limit]
        #[arg(long, value_name = "SIZE")]
        memory_limit: Option<ByteSize>,
        /// As JSON
        #[arg(long)]
        json: bool,
    },
    /// Measure a model on the held-out images of a capture; rewrites metrics.json
    #[command(after_help = "Example:\n  diamond evaluate out capture --save-images")]
    Evaluate {
        /// Folder of a finished reconstruction
        dir: PathBuf,
        /// The capture
        capture: PathBuf,
        /// Also write DIR/images/{name}_{render,truth,flip}.png
        #[arg(long)]
        save_images: bool,
        /// auto, portable (the same bits on every machine), avx2, avx512 or neon [default: auto]
        #[arg(long, value_name = "NAME")]
        instruction_set: Option<InstructionChoice>,
    },
    /// Render a model: any camera path, any light or mix of lights
    Render(RenderArguments),
    /// Say what is in a capture (cameras, lights, coverage, exposure, what is missing) or in a splat file
    #[command(after_help = "Examples:\n  diamond inspect capture\n  diamond inspect capture -o overview.png\n  \
diamond inspect bunny.spz -o bunny.png")]
    Inspect {
        /// The capture, or a splat file: .ply, .compressed.ply, .splat, .spz, .glb, .gltf
        capture: PathBuf,
        /// Also draw a picture (PNG)
        #[arg(short, long)]
        output: Option<PathBuf>,
    },
    /// Say what was found about the inside of the object: sigma_t, albedo, how far light goes; with a plot
    #[command(after_help = "Examples:
  diamond inspect-medium out
  diamond inspect-medium out --medium \"mean_free_path=*2\" -o softer.svg

The medium is DIR/medium.toml, for people to read and change: diamond render DIR --medium changed.toml.
Keys of --medium: mean_free_path (all distances), reflectance (a profile), sigma_t, albedo, g, gain (walks).
One number or three (red green blue); *2 multiplies what is there.")]
    InspectMedium {
        /// Folder of a finished reconstruction
        dir: PathBuf,
        /// With another medium: a TOML file, or changes
        #[arg(long, value_name = "FILE|KEY=VALUE,…")]
        medium: Option<String>,
        /// Where the plot goes (SVG) [default: DIR/medium.svg]
        #[arg(short, long)]
        output: Option<PathBuf>,
    },
    /// Write the Gaussians of a model for other programs
    #[command(
        after_help = "Examples:\n  diamond export out -o splats.ply\n  diamond export out -o splats.ply --materials\n  \
diamond export out -o splats.spz --turn x:180\n  diamond export out -o splats.glb\n\nColour is the base colour: linear, \
without light, the same from everywhere. What a format\ncannot hold is printed."
    )]
    Export {
        /// Folder of a finished reconstruction
        dir: PathBuf,
        /// The file to write: .ply, .splat, .spz, .glb or .gltf
        #[arg(short, long)]
        output: PathBuf,
        /// Add base colour, roughness, metalness and subsurfaceness (PLY)
        #[arg(long)]
        materials: bool,
        #[command(flatten)]
        writing: WritingArguments,
    },
    /// Read a splat file of any format and write it as another
    #[command(
        after_help = "Examples:\n  diamond convert bunny.compressed.ply bunny.ply\n  diamond convert bunny.ply bunny.glb \
--turn x:180\n  diamond convert bunny.ply bunny.spz --spz-version 4\n\nCoordinates are kept as they are unless --turn \
says otherwise. PLY customarily has y down,\nSPZ and glTF have y up: --turn x:180 (or z:180) goes from one to the other."
    )]
    Convert {
        /// The file to read: .ply, .compressed.ply, .splat, .spz, .glb or .gltf
        input: PathBuf,
        /// The file to write: .ply, .splat, .spz, .glb or .gltf
        output: PathBuf,
        #[command(flatten)]
        writing: WritingArguments,
    },
    /// Render a synthetic capture from a recipe, with its error measured against an unbiased path tracer
    #[command(after_help = "Examples:
  diamond synth assets/recipes/wax-candle.toml -o candle
  diamond synth assets/recipes/jade-figure.toml -o jade rig.views=100 rig.lights=112 --contact-sheet jade.png
  diamond synth assets/recipes/training-family.toml -o family --members 10 --shards shards
  diamond synth assets/recipes/mesh.toml -o mine object.path=/data/mine.glb material.g=0.5

Whoever is interrupted goes on with the same command. Two runs give the same bytes.
docs/captures.md says what a recipe can say and what is written.")]
    Synth {
        /// A recipe (TOML), or a family of recipes
        recipe: PathBuf,
        /// Changes to the recipe, such as rig.views=8, film.resolution=64, quality.walks=512
        #[arg(value_name = "KEY=VALUE")]
        changes: Vec<String>,
        /// The capture's folder, which must not exist; of a family, the folder of its captures
        #[arg(short, long)]
        output: PathBuf,
        /// Of a family: only the first so many members
        #[arg(long, value_name = "COUNT")]
        members: Option<u32>,
        /// Also draw many small pictures on one (PNG): views by lights, members of a family by views
        #[arg(long, value_name = "FILE")]
        contact_sheet: Option<PathBuf>,
        /// Also write the object's surface (PLY, in the capture's frame): the truth for `subsurface.surface` and for shape errors
        #[arg(long, value_name = "FILE")]
        mesh: Option<PathBuf>,
        /// Also write all images as safetensors shards into this folder, see `diamond shards`
        #[arg(long, value_name = "DIR")]
        shards: Option<PathBuf>,
    },
    /// Write captures as safetensors shards of half floats, for training by other programs
    #[command(after_help = "Examples:
  diamond shards candle -o shards
  diamond shards family/* -o shards --shard-size 32MiB
  diamond shards family/* -o shards --prior

index.json in the folder lists the shards; docs/captures.md has their layout and how to read them in Python.
Shards that are there are kept, so the same command goes on after an interruption.")]
    Shards {
        /// The captures, whose folders must have different names
        #[arg(required = true)]
        captures: Vec<PathBuf>,
        /// Folder for the shards
        #[arg(short, long)]
        output: PathBuf,
        /// Size of a shard at most; a view with all its lights is not cut
        #[arg(long, value_name = "SIZE", default_value = "64MiB")]
        shard_size: ByteSize,
        /// Also fit a medium to each capture, to each training view under one light, and write what it predicts of them all beside their shards
        #[arg(long)]
        prior: bool,
    },
    /// Files of network weights (safetensors): what they are, whether they fit, and into our names
    #[command(
        subcommand,
        after_help = "Examples:
  diamond models inspect v1-5-pruned.safetensors
  diamond models check v1-5-pruned.safetensors --model sd1-unet
  diamond models convert v1-5-pruned.safetensors -o unet.safetensors --model sd1-unet --numbers f16

No weights are contained or fetched: they are files that you have, under their own licences."
    )]
    Models(ModelsCommand),
    /// Train the relighter on shards: what a view looks like under lights that it was not photographed under
    #[command(after_help = "Examples:
  diamond shards family/* -o shards --prior
  diamond shards others/* -o test-shards --prior
  diamond train shards -o relighter --steps 5000 --test-shards test-shards
  diamond train shards -o relighter --steps 5000 --resume

The folder gets checkpoint.safetensors, curve.csv and, at the end, model.safetensors. Runs on the CPU.")]
    Train {
        /// Folder of shards, with index.json
        shards: PathBuf,
        /// Folder for the run
        #[arg(short, long)]
        output: PathBuf,
        /// Steps
        #[arg(long, default_value_t = 5000, value_parser = clap::value_parser!(u64).range(1..))]
        steps: u64,
        /// Examples of a step
        #[arg(long, default_value_t = 4, value_parser = at_least_one)]
        batch: usize,
        /// Pixels of a side that the network works at, a multiple of 8
        #[arg(long, default_value_t = 48)]
        size: usize,
        /// Largest learning rate
        #[arg(long, default_value_t = 3e-4)]
        rate: f64,
        /// Seed of every random choice
        #[arg(long, default_value_t = 0)]
        seed: u64,
        /// Steps between checkpoints
        #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u64).range(1..))]
        save_every: u64,
        /// Examples that the result is measured on
        #[arg(long, default_value_t = 60)]
        held_out: usize,
        /// Shards of other objects, whose training views the result is measured on; without, the shards' own split `test`
        #[arg(long, value_name = "DIR")]
        test_shards: Option<PathBuf>,
        /// Go on from the checkpoint, with the same options
        #[arg(long)]
        resume: bool,
    },
    /// List what this machine has to compute on
    #[command(after_help = "Example:\n  diamond devices")]
    Devices,
    /// List the presets, or print one as TOML to start a configuration from
    #[command(after_help = "Examples:\n  diamond presets\n  diamond presets resolved > mine.toml")]
    Presets {
        /// Name of a preset
        name: Option<String>,
    },
}

/// What to do with a file of weights.
#[derive(Debug, Subcommand)]
pub enum ModelsCommand {
    /// Say what a file holds and which model it fits; reads its header only
    Inspect {
        /// The file
        file: PathBuf,
    },
    /// Compare names and shapes with a model; reads the header only. Exit code 3 where it does not fit
    Check {
        /// The file
        file: PathBuf,
        /// Name of a model, as `diamond models inspect` lists them
        #[arg(long)]
        model: String,
    },
    /// Write the weights of a model under our names
    Convert {
        /// The file
        file: PathBuf,
        /// File to write (.safetensors)
        #[arg(short, long)]
        output: PathBuf,
        /// Name of a model, as `diamond models inspect` lists them
        #[arg(long)]
        model: String,
        /// How numbers are stored: f32, f16 (at most 65504) or bf16
        #[arg(long, default_value = "f16")]
        numbers: String,
    },
}

/// Options of what writes splats.
#[derive(Debug, Args)]
pub struct WritingArguments {
    /// ply, splat, spz, glb or gltf [default: what the file's name says]
    #[arg(long, value_parser = splat_format)]
    pub format: Option<SplatFormat>,
    /// Turn the cloud about an axis first: AXIS:DEGREES[,AXIS:DEGREES…]
    #[arg(long, value_parser = diamond_sss::parse_turn)]
    pub turn: Option<glam::DAffine3>,
    /// Version of SPZ: 3 is read by most programs, 4 by the newest
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(3..=4))]
    pub spz_version: u32,
}

impl WritingArguments {
    /// As the library takes them.
    pub fn options(&self, materials: bool) -> ExportOptions {
        ExportOptions {
            format: self.format,
            materials,
            turn: self.turn.unwrap_or(glam::DAffine3::IDENTITY),
            write: WriteOptions { spz_version: self.spz_version },
        }
    }
}

fn splat_format(text: &str) -> Result<SplatFormat, String> {
    SplatFormat::from_name(text).ok_or_else(|| "expected ply, splat, spz, glb or gltf".into())
}

/// Options of `reconstruct`.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  diamond reconstruct capture -o out
  diamond reconstruct capture -o out --views 3 --lights 3 --steps 3000
  diamond reconstruct capture -o out --regime v3-l3
  diamond reconstruct capture -o other --preset sss-3dgs --selection out/selection.json
  diamond reconstruct capture -o out --preset mine.toml --seed 7
  diamond reconstruct capture -o out --initial splats.ply
  diamond reconstruct capture -o out --memory-limit 2GiB
  diamond reconstruct capture -o out --resume")]
pub struct ReconstructArguments {
    /// The capture: a folder with transforms_train.json
    pub capture: PathBuf,
    /// Folder for the results
    #[arg(short, long)]
    pub output: PathBuf,
    /// resolved, sss-3dgs, paper, or a TOML file
    #[arg(long, default_value = "resolved")]
    pub preset: String,
    /// Length of the run in steps
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
    pub steps: Option<u64>,
    /// Seed of every random choice
    #[arg(long)]
    pub seed: Option<u64>,
    /// Threads; the result does not depend on it [default: all]
    #[arg(long, value_parser = clap::value_parser!(u16).range(1..))]
    pub threads: Option<u16>,
    /// auto, portable (the same bits on every machine), avx2, avx512 or neon [default: the configuration]
    #[arg(long, value_name = "NAME")]
    pub instruction_set: Option<InstructionChoice>,
    /// Where training steps are made: cpu, gpu, gpu:N (`diamond devices` lists them), or auto (a GPU that is not software, else cpu). What a device
    /// cannot do of a step is said, and the step is made on the CPU
    #[arg(long, value_name = "NAME", default_value = "cpu")]
    pub device: DeviceChoice,
    /// What the process may take in memory: 512MiB, 2GiB, bytes. Caches shrink first, which changes no result, then the
    /// number of Gaussians, which is said [default: the configuration, else no limit]
    #[arg(long, value_name = "SIZE")]
    pub memory_limit: Option<ByteSize>,
    /// Training views: a count, a share such as 5%, or indices such as 0,5,7 or 0-7
    #[arg(long, default_value = "all")]
    pub views: Selection,
    /// Training lights: a count, a share such as 5%, so many per view such as 1/view, or indices such as 0,5,7 or 0-7
    #[arg(long, default_value = "all")]
    pub lights: Selection,
    /// Views and lights by the name of a regime: full-full, full-one, v5-l5, v3-l3, v5-full, v3-full, v10-l3, 3x4…
    #[arg(long, value_name = "NAME", conflicts_with_all = ["views", "lights", "selection"])]
    pub regime: Option<Regime>,
    /// The images that a selection.json of an earlier run names, to learn from and held out
    #[arg(long, value_name = "FILE", conflicts_with_all = ["views", "lights"])]
    pub selection: Option<PathBuf>,
    /// Start from this point cloud (.ply) or these splats (.ply, .splat, .spz, .glb) instead of the capture's
    #[arg(long)]
    pub initial: Option<PathBuf>,
    /// Continue an interrupted run, with the same options
    #[arg(long, conflicts_with = "force")]
    pub resume: bool,
    /// Replace the results of an earlier run
    #[arg(long)]
    pub force: bool,
}

/// Options of `render`.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  diamond render out -o picture.png --light 2,3,4
  diamond render out -o film --orbit 60 --direction 0,0,1
  diamond render out -o picture.png --mix \"4,0,2:1,0.6,0.3;-4,0,2:0.3,0.6,1\"
  diamond render out -o rig --capture capture --view 2 --lights 16
  diamond render out -o softer.png --medium \"mean_free_path=*2\"
  diamond render out -o picture.exr --linear --size 512x512")]
pub struct RenderArguments {
    /// Folder of a finished reconstruction
    pub dir: PathBuf,
    /// A file for one picture, else a folder
    #[arg(short, long)]
    pub output: PathBuf,
    /// Capture whose held-out (or training) views --view counts [default: the training views of the run]
    #[arg(long)]
    pub capture: Option<PathBuf>,
    /// Render this view
    #[arg(long, group = "from")]
    pub view: Option<usize>,
    /// Render a turn round the object in so many frames
    #[arg(long, group = "from", value_parser = at_least_one)]
    pub orbit: Option<usize>,
    /// Render the camera or cameras of a JSON file
    #[arg(long, group = "from")]
    pub camera: Option<PathBuf>,
    /// A point light at x,y,z
    #[arg(long, group = "under", allow_hyphen_values = true)]
    pub light: Option<String>,
    /// A light at infinity in direction x,y,z (from the object to the light)
    #[arg(long, group = "under", allow_hyphen_values = true)]
    pub direction: Option<String>,
    /// Several point lights at once: "x,y,z:r,g,b;…"
    #[arg(long, group = "under", allow_hyphen_values = true)]
    pub mix: Option<String>,
    /// So many lights of an even dome, one picture each
    #[arg(long, group = "under", value_parser = at_least_one)]
    pub lights: Option<usize>,
    /// Another medium inside: a TOML file, or changes such as "mean_free_path=*2, reflectance=0.9 0.5 0.5" (see inspect-medium)
    #[arg(long, value_name = "FILE|KEY=VALUE,…")]
    pub medium: Option<String>,
    /// Size of the pictures, WIDTHxHEIGHT
    #[arg(long, value_parser = size)]
    pub size: Option<(u32, u32)>,
    /// Linear light as EXR instead of sRGB as PNG
    #[arg(long)]
    pub linear: bool,
    /// Brighter by so many stops (each doubles the light), or darker if negative
    #[arg(long, value_name = "EV", default_value_t = 0.0, allow_hyphen_values = true, value_parser = stops)]
    pub exposure: f32,
    /// Where pictures are made: cpu, gpu, gpu:N (`diamond devices` lists them), or auto (a GPU that is not software, else cpu). Rays run on the CPU
    #[arg(long, value_name = "NAME", default_value = "cpu")]
    pub device: DeviceChoice,
    /// auto, portable (the same bits on every machine), avx2, avx512 or neon [default: auto]
    #[arg(long, value_name = "NAME")]
    pub instruction_set: Option<InstructionChoice>,
}

fn stops(text: &str) -> Result<f32, String> {
    match text.parse() {
        Ok(ev) if (-20.0..=20.0).contains(&ev) => Ok(ev),
        _ => Err("expected a number from -20 to 20".into()),
    }
}

fn at_least_one(text: &str) -> Result<usize, String> {
    match text.parse() {
        Ok(n @ 1..=100_000) => Ok(n),
        _ => Err("expected a number from 1 to 100000".into()),
    }
}

/// Longest side of a rendered picture.
const MAX_SIDE: u32 = 8192;

fn size(text: &str) -> Result<(u32, u32), String> {
    let parsed = text.split_once(['x', '×']).and_then(|(w, h)| Some((w.parse().ok()?, h.parse().ok()?)));
    match parsed {
        Some((w, h)) if (1..=MAX_SIDE).contains(&w) && (1..=MAX_SIDE).contains(&h) => Ok((w, h)),
        _ => Err(format!("expected WIDTHxHEIGHT, each from 1 to {MAX_SIDE}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        use clap::CommandFactory;
        Cli::command().debug_assert();
        assert_eq!(size("64x48"), Ok((64, 48)));
        assert!(size("64").is_err() && size("0x4").is_err() && size("99999x1").is_err());
    }
}

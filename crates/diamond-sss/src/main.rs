//! The `diamond` program: reads the command line, calls the library, prints, and exits with a code that scripts can use:
//! 0 done, 1 the run failed, 2 usage, 3 bad input (capture, configuration, model files), 130 interrupted.
mod program;

fn main() -> std::process::ExitCode {
    program::main()
}

// What is in a bag, and the choices of its import.

import { useLayoutEffect, useMemo } from "preact/hooks";

import { bytes, duration } from "../format";
import type { Inspection, Options, Schema, StreamFacts } from "../types";
import { type Changes, OptionsForm } from "./options";

const KINDS = ["scans", "images", "poses", "imu", "gnss", "camera info", "transforms", "packets", "other"];

/** label: differs between the bag that is about to be uploaded and the one that is chosen. */
export function InspectionTable({ inspection, label }: { inspection: Inspection; label: string }) {
  const streams = [...inspection.streams].sort((a, b) => KINDS.indexOf(a.kind) - KINDS.indexOf(b.kind) || a.name.localeCompare(b.name));
  const firsts = streams.flatMap(({ first }) => (first === null ? [] : [first]));
  const lasts = streams.flatMap(({ last }) => (last === null ? [] : [last]));
  const seconds = firsts.length > 0 && lasts.length > 0 ? (Math.max(...lasts) - Math.min(...firsts)) / 1e9 : null;
  return (
    <section class="inspection" aria-label={label}>
      <p><strong>{inspection.format}</strong>, {bytes(inspection.size)}{seconds !== null && `, ${duration(seconds)}`}</p>
      <div class="table-scroll" tabIndex={0} role="group" aria-label={`${label}: topics`}>
        <table>
          <thead><tr><th>Topic</th><th>Kind</th><th class="number">Count</th><th class="number">Rate</th><th>What it says</th></tr></thead>
          <tbody>
            {streams.map((one) => (
              <tr key={one.name}>
                <td><code>{one.name}</code></td><td>{one.kind}</td><td class="number">{one.count ?? "?"}</td>
                <td class="number">{one.rate === null ? "" : `${one.rate.toFixed(1)} Hz`}</td><td class="small">{one.problem === "" ? said(one) : `cannot be read: ${one.problem}`}</td>
              </tr>
            ))}
          </tbody>
        </table>
      </div>
      {inspection.notes.map((note) => <p key={note} class="quiet small">{note}</p>)}
      {inspection.missing.map((sentence) => <p key={sentence} class="field-problem">Missing: {sentence}</p>)}
    </section>
  );
}

/** The facts of a stream that matter for a map. */
function said(stream: StreamFacts): string {
  const { points, width, height, stored, sweep_s: sweep, stamp_is: stamp, time_field: field, time_unit: unit, times, lens, child, acceleration_unit: gravity } = stream;
  const parts = [
    points === undefined ? "" : `${String(points)} points`,
    sweep === undefined ? (times === undefined ? "" : `times of points: ${times}`) : `times in ${field ?? ""} (${unit ?? ""}), a sweep of ${sweep.toFixed(3)} s, stamp: ${stamp ?? ""}`,
    width === undefined ? "" : `${String(width)} x ${String(height)} px`,
    stored ?? "", lens ?? "", child === undefined ? "" : `of ${child}`, gravity === undefined ? "" : `acceleration in ${gravity}`,
    ...(stream.transforms ?? []).slice(0, 6),
  ];
  return parts.filter((part) => part !== "").join(", ");
}

interface FormProps {
  options: Options;
  inspection: Inspection;
  changes: Changes;
  set: (changes: Changes) => void;
  errors: Record<string, string>;
}

/** The options of an import, with the topics and files of this bag to choose from. */
export function ImportForm({ options, inspection, changes, set, errors }: FormProps) {
  // before the form can be seen: later, it would undo what somebody has just chosen
  useLayoutEffect(() => { set(likely(inspection)); }, [inspection]);
  const offered = useMemo(() => offer(options, inspection), [options, inspection]);
  return <OptionsForm options={offered} changes={changes} set={set} errors={errors} kind="import" />;
}

function named(inspection: Inspection, kind: string): string[] {
  return inspection.streams.filter((one) => one.kind === kind && one.count !== 0).map((one) => one.name);
}

/** What must be said where several topics fit, or none. */
function likely({ streams, choice }: Inspection): Changes {
  const several = (kind: string): boolean => streams.filter((one) => one.kind === kind && one.count !== 0).length > 1;
  return {
    ...(several("scans") ? { lidar: choice.lidar } : {}),
    ...(several("images") ? { image: choice.image } : {}),
    ...(several("imu") ? { imu: choice.imu } : {}),
    ...(choice.odometry === "" ? { odometry: "auto" } : several("poses") ? { odometry: choice.odometry } : {}),
  };
}

function offer(options: Options, inspection: Inspection): Options {
  const moving = named(inspection, "transforms").filter((name) => !name.includes("static"));
  const beside = inspection.beside ?? [];
  const choices: Record<string, string[]> = {
    lidar: ["", ...named(inspection, "scans")],
    image: ["", ...named(inspection, "images"), "none"],
    imu: ["", ...named(inspection, "imu"), "none"],
    odometry: ["", ...named(inspection, "poses"), ...moving, "auto", ...beside],
    ...(inspection.presets.length > 0 ? { preset: ["", ...inspection.presets] } : {}),
  };
  const properties: Record<string, Schema> = {};
  for (const [name, schema] of Object.entries(options.schema.properties ?? {})) {
    const fitting = choices[name];
    if (name === "calibration") properties[name] = { ...schema, items: { type: "string", enum: beside } };
    else properties[name] = fitting === undefined ? schema : { ...schema, enum: fitting };
  }
  return { ...options, schema: { ...options.schema, properties } };
}

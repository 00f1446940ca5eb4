// Parts of the page's shaders, each after its name. The light is that of ar/rendering/shade.py.
//@ LIGHT
precision highp float;
uniform vec3 eye, lamp, lampAxis, base; uniform vec2 cone, light, shine;
// Share of the lamp inside its lit circle, which has a soft edge; toned light, as a display shows it.
float arrivingAt(vec3 ray) {
  float rim = clamp((-dot(ray, lampAxis) - cone.x) * cone.y, 0.0, 1.0);
  return light.x * rim * rim * (3.0 - 2.0 * rim);
}
vec3 tone(vec3 x) { return sqrt(clamp(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0.0, 1.0)); }
float ambientOn(float facing) { return light.y * (0.35 + 0.65 * max(0.0, facing)); }
float diffuse(float facing) { return max(0.0, (facing + 0.2) / 1.2); }
//@ SHADOW
varying vec3 at;
uniform vec3 ball, rod; uniform vec4 radii; // of ball, shaft, grip; distance from the ball to the grip
float shareOfLamp() {
  #ifdef SHADED
  vec3 ray = normalize(lamp - at), arm = ball - at;
  float slope = dot(ray, rod), room = max(1.0 - slope * slope, 1e-6), ahead = dot(ray, arm);
  float along = (slope * ahead - dot(rod, arm)) / room;
  float radius = mix(radii.y, radii.z, smoothstep(radii.w - radii.z, radii.w, along));
  float past = abs(dot(cross(ray, rod), arm)) * inversesqrt(room), beside = length(arm - ahead * ray);
  float shaft = along > 0.0 && ahead + slope * along > 0.0 ? smoothstep(0.8 * radius, 1.2 * radius, past) : 1.0;
  return min(shaft, smoothstep(0.8 * radii.x, 1.2 * radii.x, beside));
  #else
  return 1.0;
  #endif
}
//@ PLAIN_VERTEX
attribute vec3 place, facing; uniform mat4 view;
varying vec3 at, bright, dim;
void main() { // light at the vertices: enough for a dull surface
  vec3 ray = normalize(lamp - place), sight = normalize(eye - place), n = facing * sign(dot(facing, sight));
  float ambient = ambientOn(dot(n, sight));
  at = place; dim = tone(base * ambient);
  bright = tone(base * (ambient + arrivingAt(ray) * diffuse(dot(n, ray))));
  gl_Position = view * vec4(place, 1.0);
}
//@ PLAIN_FRAGMENT
varying vec3 bright, dim;
void main() { gl_FragColor = vec4(mix(dim, bright, shareOfLamp()), 1.0); }
//@ LIT_VERTEX
attribute vec3 place, facing; attribute vec2 texel; uniform mat4 view; uniform vec3 shift;
varying vec3 at, normal, ray, sight, middle; varying vec2 where; varying float arriving;
void main() {
  at = place + shift; normal = facing; where = texel;
  ray = normalize(lamp - at); sight = normalize(eye - at); middle = normalize(ray + sight); arriving = arrivingAt(ray);
  gl_Position = view * vec4(at, 1.0);
}
//@ LIT_FRAGMENT
varying vec3 normal, ray, sight, middle; varying vec2 where; varying float arriving;
uniform vec3 dark, right, up; uniform float relief; uniform bool textured; uniform sampler2D scan;
void main() {
  vec3 n = normal, colour = base;
  if (textured) { // value of the scan, and its slopes along right and up
    vec3 texel = texture2D(scan, where).rgb;
    vec3 tilt = relief * ((texel.g - 0.5) * right + (texel.b - 0.5) * up);
    colour *= dark + (1.0 - dark) * texel.r;
    n += dot(tilt, n) * n - tilt;
  }
  n = normalize(n);
  float came = arriving * shareOfLamp(), grazing = 1.0 - dot(sight, middle);
  float fresnel = 0.04 + 0.96 * grazing * grazing * grazing * grazing * grazing;
  float lobe = exp(shine.y * (dot(n, middle) - 1.0)) * (shine.y + 8.0) * 0.12 * fresnel;
  vec3 dull = colour * (ambientOn(dot(n, sight)) + came * diffuse(dot(n, ray)));
  gl_FragColor = vec4(tone(dull + came * shine.x * lobe), 1.0);
}
//@ GLOW_FRAGMENT
precision highp float;
varying vec3 normal, sight;
uniform vec3 base; uniform float opacity;
void main() { gl_FragColor = vec4(base * (0.35 + 0.75 * abs(dot(normalize(normal), sight))), opacity); }
//@ LINE_VERTEX
attribute vec4 corner; // x, y, side, length along the line [pixel]
uniform vec2 size;
varying vec2 along;
void main() {
  along = corner.zw;
  gl_Position = vec4(2.0 * corner.x / size.x - 1.0, 1.0 - 2.0 * corner.y / size.y, 0.0, 1.0);
}
//@ LINE_FRAGMENT
precision highp float;
varying vec2 along;
uniform vec4 ink; uniform float width, border; uniform vec2 strokes;
void main() {
  if (strokes.y > 0.0 && mod(along.y, strokes.x + strokes.y) > strokes.x) discard;
  float far = abs(along.x);
  float cover = clamp(width + border + 0.5 - far, 0.0, 1.0), core = clamp(width + 0.5 - far, 0.0, 1.0);
  gl_FragColor = vec4(mix(vec3(0.04, 0.05, 0.05), ink.rgb, border > 0.0 ? core : 1.0), ink.a * cover);
}
